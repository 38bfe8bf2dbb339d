"""Tests of `sim_hil.protocols.ros2`."""
