"""Tests of sim_hil/realtime."""
