"""Console script of `edge-hil`, which an install without pybullet has too."""

from __future__ import annotations

from edge.core.cli import run_with_extra


def main() -> int:
    """Entry point; returns the exit code."""
    return run_with_extra("edge-hil", "sim_hil.hil.command", "sim")
