"""Import of real robots' recordings as drives: SCAND and GND, as folders of images and poses (no ROS bags)."""
