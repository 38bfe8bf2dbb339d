"""Keeps the moving average of power under a budget by shedding reasoning; pure."""
