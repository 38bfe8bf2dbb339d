"""Tests of the bridge on a CAN bus."""
