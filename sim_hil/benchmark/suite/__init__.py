"""The benchmark's suite as data: episodes, and how they are built and validated."""
