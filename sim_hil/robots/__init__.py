"""Simulated robots: common interface, batteries, drifting odometry."""
