"""Console script of `edge-export`, which an installation without torch has too: there it can only verify."""

from __future__ import annotations

import importlib.util
import sys

from edge.core.cli import EXIT_INTERRUPTED, run_with_extra


def main() -> int:
    """Entry point; returns the exit code."""
    try:
        if sys.argv[1:2] == ["verify"] and importlib.util.find_spec("torch") is None:
            from edge.deploy.verify import main as verify

            return verify(sys.argv[2:])
        return run_with_extra("edge-export", "export.cli", "export")
    except KeyboardInterrupt:  # while modules load; afterwards export.cli answers itself
        sys.stderr.write("edge-export: interrupted\n")
        return EXIT_INTERRUPTED
