"""People who walk, stand, sit and queue in a scene and give way to the robot."""
