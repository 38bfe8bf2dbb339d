"""Command line of `edge-export`: builds verified artifacts for a target, or verifies existing ones.

This module does without torch, which takes seconds to load: bad arguments are refused at once.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from edge.core.cli import check_result_directory, check_result_target
from export.core.replaceable import check_replaceable
from export.evaluation.calibration_names import name_refusal
from export.model.config import TicVlaConfig, config_for, model_settings, with_overrides
from export.targets.file import Target, load_target, with_settings
from firmware_bridge.system.terminal import CommandParser

COMMAND = "edge-export"
SUMMARY = "Build verified artifacts for a target, or verify existing ones."
DEFAULT_TARGET, DEFAULT_MODEL = "cpu", "nano"
EXAMPLES = """examples:
  edge-export --target cpu --model nano --out out/nano
  edge-export --target orin --model 1b --checkpoint InternVL3-1B/ --checkpoint action.safetensors --out out/orin
  edge-export --target orin --model 1b --random-weights 0 --out out/orin
  edge-export --target orin --model 1b --set power.mode=MAXN_SUPER --dry-run
  edge-export verify out/nano
  edge-export --list-targets

exit codes: 0 done, 1 a graph fails its gates, a plan does not fit or an artifact is damaged,
            2 bad arguments or input, 130 interrupted (finished stages stay in the cache)
"""
EXPORT_ONLY = {
    "target": "--target",
    "model": "--model",
    "settings": "--set",
    "out": "--out",
    "dry_run": "--dry-run",
    "save_weights": "--save-weights",
}
"""Options that `verify` refuses, because it reads their values from the directory."""


class UsageError(ValueError):
    """Missing or contradictory arguments."""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of `edge-export`."""
    p = CommandParser(
        COMMAND,
        description=SUMMARY,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("command", nargs="?", choices=["verify"], help="verify DIR: check hashes, contract and gates again")
    p.add_argument("directory", nargs="?", type=Path, metavar="DIR", help="directory for verify")
    p.add_argument("--target", metavar="NAME|FILE.toml", help="device to export for (default: cpu)")
    p.add_argument("--list-targets", action="store_true", help="list the targets and exit")
    p.add_argument("--model", metavar="nano|1b|FILE.json", help="network (default: nano)")
    p.add_argument(
        "--checkpoint",
        type=Path,
        metavar="PATH",
        action="append",
        default=[],
        help="weights: safetensors, .ckpt/.pt or a Hugging Face directory; repeat it for parts in several files",
    )
    p.add_argument(
        "--random-weights",
        type=int,
        metavar="SEED",
        help="untrained weights of this seed (default: the shipped weights, else seed 0); with --checkpoint, only for "
        "an action expert that the checkpoint lacks",
    )
    p.add_argument("--save-weights", type=Path, metavar="PATH", help="also write the weights as safetensors")
    p.add_argument("--calibration", metavar="NAME", help="calibration set, folder:PATH or video:PATH")
    p.add_argument(
        "--set",
        dest="settings",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change the target (power.mode=MAXN_SUPER) or the network (model.action.layers=3); repeatable",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="artifact directory to write")
    p.add_argument("--dry-run", action="store_true", help="print the plan and build nothing")
    cache = p.add_mutually_exclusive_group()
    cache.add_argument("--cache", type=Path, metavar="DIR", help="cache of finished stages")
    cache.add_argument("--no-cache", action="store_true", help="neither read nor write a cache")
    p.add_argument("--cache-gb", type=float, default=20.0, metavar="GB", help="largest size of the cache (default: 20)")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def check(args: argparse.Namespace) -> None:
    """Check everything but the weights and the artifacts.

    Raises UsageError, TargetError, ModelConfigError, ArtifactError for a directory that is not replaced, or OSError.
    """
    if args.list_targets:
        return
    check_result_target(args.json)
    if not 0 < args.cache_gb < 1e6:
        raise UsageError(f"--cache-gb {args.cache_gb:g}: expected a size above 0")
    if args.random_weights is not None and not 0 <= args.random_weights < 2**63:
        raise UsageError(f"--random-weights {args.random_weights}: expected a seed from 0 to 2^63 - 1")
    for path in args.checkpoint:
        if not path.exists():
            raise UsageError(f"--checkpoint {path}: no such file or directory; expected a checkpoint")
    if args.calibration is not None and (refusal := name_refusal(args.calibration)) is not None:
        raise UsageError(refusal)
    if args.command == "verify":
        _check_verify(args)
        return
    if args.directory is not None:
        raise UsageError(f"{args.directory}: expected a directory only after verify")
    if args.out is None and not args.dry_run:
        raise UsageError("--out is missing: expected a directory to write, e.g. --out out/nano")
    check_result_directory(args.out)
    target_and_config(args)
    if not args.dry_run:
        out = Path(os.path.realpath(args.out))
        if not out.name:
            raise UsageError(f"--out {out}: expected a directory that can be created")
        check_replaceable(out)


def target_and_config(args: argparse.Namespace) -> tuple[Target, TicVlaConfig]:
    """Return target and network with all changes of --set. Raises TargetError or ModelConfigError."""
    config = with_overrides(config_for(args.model or DEFAULT_MODEL), model_settings(args.settings))
    return with_settings(load_target(args.target or DEFAULT_TARGET, config.name), args.settings), config


def _check_verify(args: argparse.Namespace) -> None:
    if args.directory is None:
        raise UsageError("verify: the directory is missing; expected: edge-export verify DIR")
    ignored = [option for name, option in EXPORT_ONLY.items() if getattr(args, name)]
    if ignored:
        raise UsageError(f"verify: {ignored[0]} has no effect on existing artifacts; leave it out")
    if not args.directory.is_dir():
        raise UsageError(f"verify {args.directory}: not a directory; create it with edge-export --out")
    if args.json not in (None, "-") and args.directory.resolve() in Path(os.path.realpath(args.json)).parents:
        raise UsageError(f"--json {args.json}: lies inside the directory to verify; name a path outside it")
