"""A scene as data: its parts, strict reading and writing, where a robot can go, and a map from above."""
