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
    write_result,
)
from export.arguments import COMMAND, DEFAULT_MODEL, DEFAULT_TARGET, UsageError, check, parser, target_and_config
from export.core.cache import StageCache, default_cache_dir, open_cache, remove_abandoned
from export.evaluation.calibration import CalibrationError, load_calibration
from export.evaluation.gates import GateError
from export.model.config import PRESETS, ModelConfigError, TicVlaConfig
from export.model.weights import WeightsError, save_weights
from export.pipeline.artifacts import build_artifacts, verify_directory
from export.pipeline.build import build_stages
from export.pipeline.early_checks import check_settings
from export.pipeline.job import ExportRequest, Job, WeightSource, job_of
from export.plan.plan import PlanError, plan
from export.plan.table import plan_lines, plan_table
from export.quantize.precision import PrecisionError
from export.targets.file import Target, list_targets, load_target
from export.targets.sections import TargetError
from firmware_bridge.system.terminal import one_line
from reporting.progress import BuildProgress, peak_rss_bytes

DEFAULT_CALIBRATION = "corridor-go2"
_TEMPORARY = ".edge-export-"
"""Prefix of a `--no-cache` export's folder of stages, beside its output."""
BAD_INPUT = (ArtifactError, CalibrationError, ModelConfigError, WeightsError, TargetError, OSError)


def _log(line: str) -> None:
    sys.stderr.write(f"{COMMAND}: {one_line(line)}\n")


def _request(args: argparse.Namespace) -> ExportRequest:
    target, model = args.target or DEFAULT_TARGET, args.model or DEFAULT_MODEL
    shipped = target if target in list_targets() else None
    return ExportRequest(shipped, model if model in PRESETS else None, tuple(args.settings))


def _check_plan(target: Target, config: TicVlaConfig, args: argparse.Namespace) -> None:
    """Refuse settings or a plan that do not fit, before anything is built; with --dry-run, print the plan first."""
    try:
        made = plan(target, config)
        check_settings(target, config, made)
    except (PlanError, PrecisionError) as error:
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
    target, config = target_and_config(args)
    _check_plan(target, config, args)
    if args.dry_run:
        return None
    out = Path(os.path.realpath(args.out))
    written: dict[Path, str] = {}
    for option, path in (("--save-weights", args.save_weights), ("--json", args.json)):
        if path is None or str(path) == "-":
            continue
        real = Path(os.path.realpath(path))
        if (other := written.setdefault(real, option)) != option:
            raise UsageError(f"{option} {path}: is also the file of {other}; name another one")
        if real == out or out in real.parents:
            raise UsageError(
                f"{option} {path}: lies inside --out, which is replaced as a whole; name a path outside it"
            )
        check_result_target(str(path), option)
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
    limit_bytes = round(args.cache_gb * 1e9)
    if args.no_cache:
        if beside is not None:
            beside.mkdir(parents=True, exist_ok=True)
            remove_abandoned(beside, _TEMPORARY)
        with (
            tempfile.TemporaryDirectory(prefix=_TEMPORARY, dir=beside) as directory,
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
    # They end the export like Ctrl-C: partial output is deleted, finished stages stay in the cache.
    ending = [s for s in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(s) is not signal.SIG_IGN]  # nohup ignores
    previous = {number: signal.signal(number, _interrupt) for number in ending}
    try:
        return _main(args, started_ns)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


def _main(args: argparse.Namespace, started_ns: int) -> int:
    if args.list_targets:
        for name in list_targets():
            sys.stdout.write(f"{name}\t{load_target(name).description}\n")
        return EXIT_DONE
    try:
        check(args)
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
