"""Training scenes and tasks, and what is true of them: routes, progress, reasoning traces, walls."""
