"""`edge-export`: build verified artifacts for a target, or verify existing ones."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_target,
    command_line,
    describe_os_error,
    named_file,
    printable,
    write_result,
)
from export.core.cache import StageCache, default_cache_dir, open_cache
from export.evaluation.calibration import CalibrationError, load_calibration
from export.evaluation.gates import GateError
from export.model.config import PRESETS, ModelConfigError, TicVlaConfig, config_for, model_settings, with_overrides
from export.model.weights import WeightsError, save_weights
from export.pipeline.artifacts import build_artifacts, check_replaceable, verify_directory
from export.pipeline.build import build_stages
from export.pipeline.job import ExportRequest, Job, WeightSource, job_of
from export.plan.plan import PlanError, plan
from export.plan.table import plan_lines, plan_table
from export.targets.file import Target, list_targets, load_target, with_settings
from export.targets.sections import TargetError
from reporting.progress import BuildProgress, peak_rss_bytes

COMMAND = "edge-export"
DEFAULT_TARGET, DEFAULT_MODEL = "cpu", "nano"
DEFAULT_CALIBRATION = "corridor-go2"
EXAMPLES = """examples:
  edge-export --target cpu --model nano --out out/nano
  edge-export --target orin --model 1b --checkpoint InternVL3-1B/ --checkpoint action.safetensors --out out/orin
  edge-export --target orin --model 1b --random-weights 0 --out out/orin
  edge-export --target orin --model 1b --set power.mode=25W --dry-run
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
BAD_INPUT = (ArtifactError, CalibrationError, ModelConfigError, WeightsError, TargetError, OSError)


class UsageError(ValueError):
    """Missing or contradictory arguments."""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of `edge-export`."""
    p = argparse.ArgumentParser(
        COMMAND, description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
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
        help="change the target (power.mode=25W) or the network (model.action.layers=3); repeatable",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="artifact directory to write")
    p.add_argument("--dry-run", action="store_true", help="print the plan and build nothing")
    cache = p.add_mutually_exclusive_group()
    cache.add_argument("--cache", type=Path, metavar="DIR", help="cache of finished stages")
    cache.add_argument("--no-cache", action="store_true", help="neither read nor write a cache")
    p.add_argument("--cache-gb", type=float, default=20.0, metavar="GB", help="largest size of the cache (default: 20)")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def _log(line: str) -> None:
    sys.stderr.write(f"{COMMAND}: {printable(line)}\n")


def _target_and_config(args: argparse.Namespace) -> tuple[Target, TicVlaConfig]:
    config = with_overrides(config_for(args.model or DEFAULT_MODEL), model_settings(args.settings))
    return with_settings(load_target(args.target or DEFAULT_TARGET, config.name), args.settings), config


def _request(args: argparse.Namespace) -> ExportRequest:
    target, model = args.target or DEFAULT_TARGET, args.model or DEFAULT_MODEL
    shipped = target if target in list_targets() else None
    return ExportRequest(shipped, model if model in PRESETS else None, tuple(args.settings))


def _check_plan(target: Target, config: TicVlaConfig, args: argparse.Namespace) -> None:
    """Refuse a plan that does not fit, before anything is built; with --dry-run, print the plan first."""
    try:
        made = plan(target, config)
    except PlanError as error:
        raise UsageError(str(error)) from error
    if args.dry_run:
        console = Console(stderr=True)
        if console.is_terminal:
            console.print(plan_table(made))
        else:
            sys.stderr.write("\n".join(plan_lines(made)) + "\n")
        write_result(args.json, {"target": target.name, "model": config.name, "plan": made.to_dict()})
    if target.runtime.enforce_plan:
        made.require()


def _export(args: argparse.Namespace) -> dict[str, Any] | None:
    if args.out is None and not args.dry_run:
        raise UsageError("--out is missing: expected a directory to write, e.g. --out out/nano")
    check_result_target(args.json)
    target, config = _target_and_config(args)
    _check_plan(target, config, args)
    if args.dry_run:
        return None
    out = Path(os.path.realpath(args.out))
    if not out.name:
        raise UsageError(f"--out {out}: expected a directory that can be created")
    for option, path in (("--save-weights", args.save_weights), ("--json", args.json)):
        if path is None or str(path) == "-":
            continue
        real = Path(os.path.realpath(path))
        if real == out or out in real.parents:
            raise UsageError(
                f"{option} {path}: lies inside --out, which is replaced as a whole; name a path outside it"
            )
        check_result_target(str(path), option)
    check_replaceable(out)
    weights = WeightSource(config, args.checkpoint, args.random_weights)
    job = Job(target, weights, load_calibration(args.calibration or DEFAULT_CALIBRATION), _request(args))
    with _cache(args, out.parent) as cache:
        run = f"{target.name} {config.name}"
        progress = BuildProgress(COMMAND, build_stages(job, cache.timings(run)))
        try:
            with progress:
                report = build_artifacts(job, out, cache, progress)
                if args.save_weights is not None:
                    loaded = job.weights.loaded
                    with named_file(args.save_weights) as path:
                        save_weights(loaded.model, path, loaded.info)
        finally:
            cache.remember_timings(run, progress.built_s)
    if not report["model"]["trained"]:
        _log("the weights are untrained: the robot will move but not navigate")
    return {**_result(report), "out": str(args.out), "stage_s": progress.built_s}


def _verify(args: argparse.Namespace) -> dict[str, Any]:
    if args.directory is None:
        raise UsageError("verify: the directory is missing; expected: edge-export verify DIR")
    ignored = [option for name, option in EXPORT_ONLY.items() if getattr(args, name)]
    if ignored:
        raise UsageError(f"verify: {ignored[0]} has no effect on existing artifacts; leave it out")
    if not args.directory.is_dir():
        raise UsageError(f"verify {args.directory}: not a directory; create it with edge-export --out")
    check_result_target(args.json)
    load_artifacts(args.directory)
    job, notes = job_of(args.directory, args.checkpoint, args.random_weights, args.calibration)
    for note in notes:
        _log(note)
    with _cache(args, None) as cache:
        run = f"verify {job.target.name} {job.config.name}"
        progress = BuildProgress(COMMAND, build_stages(job, cache.timings(run), graphs=False))
        with progress:
            report = verify_directory(job, args.directory, cache, progress)
        cache.remember_timings(run, progress.built_s)
    return {**_result(report), "stage_s": progress.built_s}


@contextmanager
def _cache(args: argparse.Namespace, beside: Path | None) -> Iterator[StageCache]:
    if not 0 < args.cache_gb < 1e6:
        raise UsageError(f"--cache-gb {args.cache_gb:g}: expected a size above 0")
    limit_bytes = round(args.cache_gb * 1e9)
    if args.no_cache:
        if beside is not None:
            beside.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix=".edge-export-", dir=beside) as directory,
            open_cache(Path(directory), limit_bytes, _log) as cache,
        ):
            yield cache
        return
    with open_cache(args.cache or default_cache_dir(os.environ), limit_bytes, _log) as cache:
        yield cache


def _result(report: dict[str, Any]) -> dict[str, Any]:
    graphs = {
        name: {key: graph[key] for key in ("params", "bytes", "precision", "precision_reason", "parity")}
        for name, graph in report["graphs"].items()
    }
    return {"target": report["target"], "model": report["model"]["name"], "graphs": graphs, "plan": report["plan"]}


@command_line("edge-export")
def main(argv: Sequence[str] | None = None) -> int:
    """Run `edge-export` and return its exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    # SIGTERM ends the export like Ctrl-C: partial output is deleted, finished stages stay in the cache.
    previous = signal.signal(signal.SIGTERM, _interrupt)
    try:
        return _main(args, started_ns)
    finally:
        signal.signal(signal.SIGTERM, previous)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


def _main(args: argparse.Namespace, started_ns: int) -> int:
    if args.list_targets:
        for name in list_targets():
            sys.stdout.write(f"{name}\t{load_target(name).description}\n")
        return EXIT_DONE
    try:
        result = _verify(args) if args.command == "verify" else _export(args)
        if result is not None:
            result["peak_rss_bytes"] = peak_rss_bytes()
            result["wall_s"] = (time.monotonic_ns() - started_ns) / 1e9
            write_result(args.json, result)
    except (GateError, PlanError) as error:
        _log(str(error) if args.command == "verify" or args.dry_run else f"{error}; nothing was written")
        return EXIT_CHECK_FAILED
    except (UsageError, *BAD_INPUT) as error:
        places = f"{args.directory or args.out or 'output'} (or the cache)"
        _log(describe_os_error(error, places) if isinstance(error, OSError) else str(error))
        # An artifact that does not verify is a failed check; anything else here is bad input.
        return EXIT_CHECK_FAILED if args.command == "verify" and isinstance(error, ArtifactError) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        _log(f"interrupted; {'nothing was kept' if args.no_cache else 'finished stages are in the cache'}")
        return EXIT_INTERRUPTED
    if result is not None and args.json != "-":
        for name, graph in result["graphs"].items():
            parity = graph["parity"]
            _log(f"{name}: {graph['params']:,} parameters, cosine {parity['cosine']:.7f}, {parity['verdict']}")
        _log(f"{result['wall_s']:.1f} s, peak memory {result['peak_rss_bytes'] / 1e9:.2f} GB")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
