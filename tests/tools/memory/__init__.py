"""Tests of tools/memory."""
