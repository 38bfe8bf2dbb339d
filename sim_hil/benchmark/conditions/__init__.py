"""Conditions of a run, apart from its episodes: mode, latency, drift, variant, wording."""
