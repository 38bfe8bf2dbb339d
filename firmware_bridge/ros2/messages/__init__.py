"""ROS 2 messages as DDS types, without a ROS installation."""
