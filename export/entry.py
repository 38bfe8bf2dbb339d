"""Console script of `edge-export`, which an install without torch has too."""

from __future__ import annotations

from edge.cli import run_with_extra


def main() -> int:
    """Entry point; returns the exit code."""
    return run_with_extra("edge-export", "export.cli", "export")
