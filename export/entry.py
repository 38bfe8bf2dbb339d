"""Console script of `edge-export`, which an install without torch has too."""

from __future__ import annotations

import sys

from edge.core.cli import EXIT_INTERRUPTED, run_with_extra


def main() -> int:
    """Entry point; returns the exit code."""
    try:
        return run_with_extra("edge-export", "export.cli", "export")
    except KeyboardInterrupt:  # while modules load; afterwards export.cli answers itself
        sys.stderr.write("edge-export: interrupted\n")
        return EXIT_INTERRUPTED
