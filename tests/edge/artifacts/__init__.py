"""Tests of `edge.artifacts`."""
