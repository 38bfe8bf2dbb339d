"""Tests of `sim_hil.robots`."""
