"""A scene file run end to end: its tables are stages, a run is a loop over the stages that are there."""
