"""A DDS participant on one interface, for the protocols that use DDS: Unitree and ROS 2."""
