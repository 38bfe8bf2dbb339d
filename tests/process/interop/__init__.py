"""Tests of the simulated robots with other people's clients, and those clients' scripts."""
