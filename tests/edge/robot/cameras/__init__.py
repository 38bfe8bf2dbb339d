"""Tests of `edge/robot/cameras`."""
