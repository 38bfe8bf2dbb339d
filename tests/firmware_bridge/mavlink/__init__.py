"""Tests of the MAVLink backend."""
