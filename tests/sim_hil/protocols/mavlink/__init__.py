"""Tests of `sim_hil.protocols.mavlink`."""
