"""Tests of `export.model`."""
