"""Helpers for tests of the exporter."""
