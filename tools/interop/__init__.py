"""Sessions with other people's clients of the robot's protocols."""
