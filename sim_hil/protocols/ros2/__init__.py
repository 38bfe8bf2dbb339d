"""The simulated Carter as a ROS 2 base: DDS topics as a driver and a camera node publish them."""
