"""Tests of `sim_hil.scene`."""
