"""The only process that commands the robot, and the client that the runner commands it through."""
