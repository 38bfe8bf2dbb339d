"""Stage 2: the action expert learns to drive with delayed semantic states."""
