"""Tests of `edge.inference`."""
