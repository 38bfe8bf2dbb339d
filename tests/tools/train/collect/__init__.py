"""Tests of `tools.train.collect`."""
