"""The simulated robots behind their real protocols, the benchmark, and long runs."""
