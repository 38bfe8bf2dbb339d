"""Simulated Carter: a wheeled base with drive, sensors, odometry and battery."""
