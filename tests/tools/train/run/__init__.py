"""Tests of `tools.train.run`."""
