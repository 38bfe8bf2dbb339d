"""Tests of `tools.train.encoder`."""
