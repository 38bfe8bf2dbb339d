"""Converts the shared weights to every peer's format."""
