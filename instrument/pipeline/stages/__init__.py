"""The stages that come with the package, one table of a scene file each."""
