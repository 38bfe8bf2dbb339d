"""Accuracy of a rounded model: references, metrics, task error, gates, and the choice of precision."""
