"""Tests of `edge.odometry`."""
