"""Scenes as data: parts, strict reading and writing, navigation grid, and a map from above."""
