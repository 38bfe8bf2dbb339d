"""From a plan to a velocity command within its limits, and ways out when the robot stands still or is stuck."""
