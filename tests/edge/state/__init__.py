"""Tests of `edge.state`."""
