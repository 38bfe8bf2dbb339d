"""Tests of `edge.robot`."""
