"""The simulated Carter: a wheeled base with its drive, sensors, odometry and battery."""
