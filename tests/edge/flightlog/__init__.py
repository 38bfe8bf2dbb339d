"""Tests of `edge.flightlog`."""
