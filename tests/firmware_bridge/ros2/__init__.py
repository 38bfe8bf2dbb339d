"""Tests of `firmware_bridge.ros2`."""
