"""The fault table: every fault, what the robot does then, how soon, and the test that injects it."""
