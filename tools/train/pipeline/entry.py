"""Console script of `edge-train`, which an install without torch or pybullet has too."""

from __future__ import annotations

import sys

from edge.core.cli import EXIT_INTERRUPTED, run_with_extra


def main() -> int:
    """Entry point; returns the exit code."""
    try:
        return run_with_extra("edge-train", "tools.train.cli", "export,sim")
    except KeyboardInterrupt:  # while modules load; afterwards tools.train.cli answers itself
        sys.stderr.write("edge-train: interrupted\n")
        return EXIT_INTERRUPTED
