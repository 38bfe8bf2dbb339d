"""Builds, verifies and reports an artifact directory."""
