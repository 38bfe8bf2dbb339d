"""Stage 0: training of the vision encoder on rendered images with known labels."""
