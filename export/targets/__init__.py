"""Targets as validated dataclasses, read from `export/targets/*.toml` or from a user's file."""
