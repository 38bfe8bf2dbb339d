"""Tests of `tools.train.drives`."""
