"""Tests of `sim_hil.protocols.unitree`."""
