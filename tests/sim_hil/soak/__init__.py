"""Tests of `sim_hil.soak`."""
