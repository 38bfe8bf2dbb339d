"""Stage 2: the action expert learns to drive from semantic states that are seconds old."""
