"""Execution of episodes: jobs, worker processes, a Ray cluster, virtual and real time."""
