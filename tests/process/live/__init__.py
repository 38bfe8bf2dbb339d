"""The processes that show a run to others: the live view and the ROS 2 node."""
