"""Helpers for tests of the runner: benches for both loops, synthetic runs, floor pictures."""
