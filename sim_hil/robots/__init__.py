"""What every simulated robot has: the interface to the world, a battery, drifting odometry."""
