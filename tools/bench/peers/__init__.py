"""Benchmark of other runtimes on this project's shapes and weights, in a separate environment (`install.sh`)."""
