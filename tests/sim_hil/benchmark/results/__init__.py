"""Tests of `sim_hil.benchmark.results`."""
