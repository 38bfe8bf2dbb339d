"""Traces of a CAN bus: `record` drives the simulated Carter and writes one, `check` judges it independently."""
