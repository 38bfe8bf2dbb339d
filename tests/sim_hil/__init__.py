"""Tests of `sim_hil`."""
