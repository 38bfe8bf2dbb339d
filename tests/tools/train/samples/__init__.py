"""Tests of `tools.train.samples`."""
