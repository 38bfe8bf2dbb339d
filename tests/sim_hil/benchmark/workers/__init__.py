"""Tests of `sim_hil.benchmark.workers`."""
