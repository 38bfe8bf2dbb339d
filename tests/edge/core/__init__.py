"""Tests of `edge.core`."""
