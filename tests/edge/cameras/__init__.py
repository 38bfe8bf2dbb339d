"""Tests of `edge/cameras`."""
