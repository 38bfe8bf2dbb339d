"""`python -m tools.faults`: make everything go wrong that may, and measure at the robot how soon it is told to stop."""
