"""Tests of `edge.flightlog.explain`."""
