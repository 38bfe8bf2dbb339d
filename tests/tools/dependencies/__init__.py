"""Tests of tools/dependencies."""
