"""Harness that gives every command bad arguments, files and outputs, and judges the answers."""
