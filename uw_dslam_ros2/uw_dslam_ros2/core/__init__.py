"""Numbers in, numbers out: no ROS, no files, no clock, no global state."""
