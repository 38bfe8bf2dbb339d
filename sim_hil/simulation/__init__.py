"""Simulated world: a robot and people under physics, and the images of the robot's camera."""
