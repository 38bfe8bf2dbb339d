"""Tests of `edge.power`."""
