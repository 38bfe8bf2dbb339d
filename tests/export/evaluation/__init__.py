"""Tests of `export.evaluation`."""
