"""Tests of `sim_hil.protocols.can`."""
