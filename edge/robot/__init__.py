"""What belongs to the robot: its camera, its states as inputs of a run, and arming it through the bridge."""
