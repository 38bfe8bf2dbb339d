"""`edge-doctor`: checks this machine, the artifacts and the link to the robot, and tells what to do."""
