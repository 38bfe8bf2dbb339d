"""What a run was asked for, apart from its episodes: mode, latency, drift, variant, wording."""
