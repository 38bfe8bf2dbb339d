"""Instructions for routes through a scene: generation and parsing."""
