"""Tests of `sim_hil.simulation`."""
