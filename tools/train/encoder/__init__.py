"""Stage 0: trains the vision encoder on rendered pictures with known labels."""
