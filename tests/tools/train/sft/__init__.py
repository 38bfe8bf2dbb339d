"""Tests of `tools.train.sft`."""
