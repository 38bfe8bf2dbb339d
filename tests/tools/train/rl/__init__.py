"""Tests of `tools.train.rl`."""
