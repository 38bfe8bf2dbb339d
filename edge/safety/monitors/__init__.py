"""Monitors: each checks one input of the runner in every step and reports what is wrong with it."""
