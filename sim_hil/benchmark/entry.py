"""Console script of `edge-bench`; it also exists in an installation without pybullet."""

from __future__ import annotations

from edge.core.cli import run_with_extra


def main() -> int:
    """Run `edge-bench` and return its exit code; without the extra `sim`, print how to install it."""
    return run_with_extra("edge-bench", "sim_hil.benchmark.cli", "sim")
