"""Tests of `sim_hil.benchmark.policies`."""
