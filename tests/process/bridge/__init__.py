"""Tests that start the bridge and end, freeze or replace it or its clients."""
