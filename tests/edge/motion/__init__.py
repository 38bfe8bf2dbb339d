"""Tests of `edge.motion`."""
