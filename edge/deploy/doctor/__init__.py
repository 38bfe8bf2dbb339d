"""`edge-doctor`: checks this machine, the artifacts and the link to the robot, and advises what to do."""
