"""Recordings of real robots as drives: SCAND and GND, as folders of pictures and poses (never ROS bags)."""
