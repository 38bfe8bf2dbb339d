"""Tests of `export.pipeline`."""
