"""Tests of `tools.train`."""
