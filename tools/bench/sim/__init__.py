"""Benchmarks of the simulation, and the courses that robots are measured on."""
