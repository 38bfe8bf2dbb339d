"""Benchmarks that print one table each: `python -m tools.bench.NAME`."""
