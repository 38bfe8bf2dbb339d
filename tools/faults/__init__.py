"""`python -m tools.faults`: inject every fault and measure at the robot how soon it receives the stop."""
