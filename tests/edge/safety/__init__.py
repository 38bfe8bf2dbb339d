"""Tests of `edge.safety`."""
