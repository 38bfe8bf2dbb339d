"""Tests of `edge.deploy`."""
