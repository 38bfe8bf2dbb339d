"""Tests of `firmware_bridge.unitree`."""
