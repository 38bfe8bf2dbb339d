"""Recorded drives on disk, the scenes and tasks they are recorded in, and their labels: futures, progress, texts."""
