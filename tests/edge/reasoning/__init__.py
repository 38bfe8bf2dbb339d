"""Tests of `edge.reasoning`."""
