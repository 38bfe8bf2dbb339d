"""Topics of a base that takes a ROS 2 Twist, over DDS and without a ROS installation."""
