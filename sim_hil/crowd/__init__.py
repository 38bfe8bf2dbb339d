"""Crowd simulation: people walk, stand, sit and queue in a scene and avoid each other and the robot."""
