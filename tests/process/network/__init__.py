"""Tests that start the network shim."""
