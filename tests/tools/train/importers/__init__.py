"""Tests of `tools.train.importers`."""
