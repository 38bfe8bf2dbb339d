"""The error that every part of training raises."""

from __future__ import annotations


class TrainError(ValueError):
    """Arguments, files, weights or data that cannot be used; one line: what, expected, found, what to do."""
