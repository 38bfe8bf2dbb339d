"""Tests of `sim_hil.layouts`."""
