"""Tests of `export.graphs`."""
