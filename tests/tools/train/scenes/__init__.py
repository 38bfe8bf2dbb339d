"""Tests of `tools.train.scenes`."""
