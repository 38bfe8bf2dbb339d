"""Helpers for tests of the benchmark: small episodes and fake workers."""
