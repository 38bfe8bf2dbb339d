"""`edge-doctor`: checks this machine, the artifacts and the link to the robot, and says what to do."""
