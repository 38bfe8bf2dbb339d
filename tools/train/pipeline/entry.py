"""Console script of `edge-train`; it also exists in installations without torch or pybullet."""

from __future__ import annotations

import sys

from edge.core.cli import EXIT_INTERRUPTED, run_with_extra


def main() -> int:
    """Run `edge-train` and return its exit code."""
    try:
        return run_with_extra("edge-train", "tools.train.cli", "export,sim")
    except KeyboardInterrupt:  # while modules load; later, tools.train.cli handles it
        sys.stderr.write("edge-train: interrupted\n")
        return EXIT_INTERRUPTED
