"""Tests of `export.checkpoint`."""
