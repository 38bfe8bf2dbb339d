"""Check the licences of all packages, and write what a release needs about them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_target,
    command_line,
    messages,
    write_named,
)
from firmware_bridge.system.terminal import CommandParser
from tools.dependencies.documents import bill_of_materials, notice
from tools.dependencies.hashes import Hashes, hashes_of, pinned_for, platforms, run_pip, with_hashes
from tools.dependencies.licences import PROJECT, LicenceError, installed, problems, read_policy

REPOSITORY: Final = Path(__file__).resolve().parents[2]
CONSTRAINTS: Final = REPOSITORY / "constraints.txt"
HASHED: Final = REPOSITORY / "constraints-hashed.txt"
NOTICE: Final = REPOSITORY / "NOTICE"

EXAMPLES: Final = """examples:
  python -m tools.dependencies check                  # every licence against tools/dependencies/policy.toml
  python -m tools.dependencies notice                 # writes NOTICE
  python -m tools.dependencies sbom --extras cpu,unitree --out out/sbom.json     # CycloneDX 1.6
  python -m tools.dependencies hashes                 # writes constraints-hashed.txt; asks the package index

check, notice and sbom read the metadata of this environment: install the extras export, sim, dev and cluster first.
exit codes: 0 done, 1 a licence is not permitted, 2 bad arguments or input, 130 interrupted
"""
_print = messages("dependencies")


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    p = CommandParser(
        "python -m tools.dependencies", description=__doc__, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    jobs = p.add_subparsers(dest="job", required=True, metavar="JOB")
    jobs.add_parser("check", help="compare every licence with the policy")
    for job, default, purpose in (
        ("notice", NOTICE, "write the NOTICE file"),
        ("sbom", None, "write a CycloneDX bill of materials"),
        ("hashes", HASHED, "write the constraints with hashes"),
    ):
        writing = jobs.add_parser(job, help=purpose)
        writing.add_argument("--out", default=default, required=default is None, metavar="FILE", help="file to write")
        if job == "sbom":
            writing.add_argument("--extras", default="", metavar="A,B", help="extras beside the base install")
    return p


@command_line("dependencies", {LicenceError: EXIT_BAD_INPUT, OSError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    check_result_target(str(args.out) if "out" in args else None, "--out")
    if args.job == "hashes":
        return _hashes(Path(args.out))
    policy = read_policy()
    packages, absent = installed(policy)
    wrong = problems(packages, policy)
    for line in wrong:
        _print(line)
    if absent:
        _print(f"not installed here, so not checked: {', '.join(absent)}")
    if wrong:
        return EXIT_CHECK_FAILED
    if args.job == "check":
        _print(f"{len(packages)} packages, all under licences that the policy permits")
    elif args.job == "notice":
        write_named(Path(args.out), notice(packages))
    else:
        known = {extra for package in packages for extra in package.extras}
        chosen = [extra for extra in args.extras.split(",") if extra]
        unknown = sorted(set(chosen) - known)
        if unknown:
            raise LicenceError(f"--extras {unknown[0]}: expected some of {', '.join(sorted(known))}")
        document = bill_of_materials(packages, version(PROJECT), chosen)
        write_named(Path(args.out), json.dumps(document, indent=1) + "\n")
    return EXIT_DONE


def _hashes(out: Path) -> int:
    packages, _ = installed(read_policy())
    found: Hashes = {}
    for platform in platforms():
        for key, hashes in hashes_of(platform, pinned_for(platform, packages, CONSTRAINTS), run_pip).items():
            found.setdefault(key, set()).update(hashes)
        _print(f"{platform.machine}, Python {platform.python}: {len(found)} packages so far")
    write_named(out, with_hashes(CONSTRAINTS, found, packages, platforms()))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
