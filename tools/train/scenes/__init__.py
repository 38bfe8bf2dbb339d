"""Training scenes and tasks, and their ground truth: routes, progress, reasoning traces, walls."""
