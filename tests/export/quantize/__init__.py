"""Tests of `export.quantize`."""
