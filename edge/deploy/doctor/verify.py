"""`edge-export verify DIR` on a robot's computer, which has no torch: hashes, contract, self-test, providers.

The gates compare with torch; they belong to the computer that exports.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED, command_line
from edge.deploy.doctor.check import Level
from edge.deploy.doctor.graphs import profile_graph, self_test
from edge.inference import engines
from firmware_bridge.system.terminal import CommandParser, one_line


@command_line("edge-export")
def main(argv: Sequence[str] | None = None) -> int:
    """Verify an artifact directory without torch; returns the exit code."""
    parser = CommandParser("edge-export", description=__doc__)
    parser.add_argument("verify", choices=["verify"], help=argparse.SUPPRESS)
    parser.add_argument("directory", type=Path, metavar="DIR", help="artifact directory")
    args = parser.parse_args(argv)
    try:
        artifacts = engines.with_built_engines(load_artifacts(args.directory.absolute()))
    except (ArtifactError, engines.EngineError) as error:
        sys.stderr.write(f"edge-export: {one_line(error)}\n")
        return EXIT_CHECK_FAILED if isinstance(error, ArtifactError) else EXIT_REFUSED
    tested, opened = self_test(artifacts)
    checks = [tested]
    if opened is not None:  # a graph that fails may also loop
        checks += [profile_graph(artifacts, name, opened.guard) for name in artifacts.graphs]
    for check in checks:
        sys.stderr.write(f"edge-export: {check.name}: {check.found}\n")
    sys.stderr.write("edge-export: hashes and contract hold; the gates were not repeated: torch is not installed\n")
    return EXIT_CHECK_FAILED if any(check.level is Level.FAIL for check in checks) else EXIT_DONE
