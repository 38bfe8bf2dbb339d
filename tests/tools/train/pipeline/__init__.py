"""Tests of `tools.train.pipeline`."""
