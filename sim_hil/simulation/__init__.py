"""The simulated world: a robot and people under physics, and the pictures of the robot's camera."""
