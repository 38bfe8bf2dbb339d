"""Tests of `tools.train.imitate`."""
