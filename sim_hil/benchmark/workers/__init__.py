"""Runs episodes: jobs, worker processes, a Ray cluster, virtual and real time."""
