"""Tests of `edge.run`."""
