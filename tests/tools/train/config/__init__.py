"""Tests of `tools.train.config`."""
