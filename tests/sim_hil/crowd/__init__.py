"""Tests of `sim_hil.crowd`."""
