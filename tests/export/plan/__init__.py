"""Tests of `export.plan`."""
