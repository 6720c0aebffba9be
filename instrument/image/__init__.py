"""Images: dirty images and point spread functions of visibilities, and the cube they come in."""
