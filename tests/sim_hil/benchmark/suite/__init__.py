"""Tests of `sim_hil.benchmark.suite`."""
