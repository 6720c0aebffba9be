"""Files of other programs and of this one."""
