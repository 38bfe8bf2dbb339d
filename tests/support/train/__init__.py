"""Helpers for tests of training: made-up drives, stages as one of several ranks."""
