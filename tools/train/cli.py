"""`edge-train`: train navigation weights from scratch, one stage at a time or all stages in order."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import FrameType
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    OutputError,
    command_line,
    write_result,
    write_whole,
)
from firmware_bridge.system.terminal import one_line
from reporting.progress import duration, peak_rss_bytes
from sim_hil.benchmark.runs import RunsError
from tools.train.arguments import BORROWED, COMMAND, check, own_profile, parser
from tools.train.config.checks import TrainError
from tools.train.config.recipe import Recipe, stage_seed
from tools.train.pipeline import chain
from tools.train.pipeline.chain import Step, is_done, may_begin, run_step, steps_of
from tools.train.pipeline.model_card import ship, write_card
from tools.train.run.curves import draw_curves
from tools.train.run.distributed import SINGLE, Ranks, computes_bf16, leave, ranks_of_environment
from tools.train.run.job import StageFailedError, StageJob, StopFlag, progress_for
from tools.train.run.network_file import ExportError
from tools.train.run.run_dir import RunDir, take_drives

PACKAGES: Final = ("calib.", "edge.", "export.", "sim_hil.", "tools.")
"""Packages whose errors carry a one-line message for the user."""


@command_line("edge-train")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    try:
        result = _main(args)
        result["peak_rss_bytes"] = peak_rss_bytes()
        result["wall_s"] = round((time.monotonic_ns() - started_ns) / 1e9, 3)
        if _speaks():
            write_result(args.json, result)
    except KeyboardInterrupt:
        again = "; continue with --resume" if args.out is not None else ""
        line = f"interrupted, finished work is kept{again}"
        return _fail(EXIT_INTERRUPTED, line) if _speaks() else EXIT_INTERRUPTED
    except (ExportError, OutputError, RunsError, StageFailedError) as error:
        return _fail(EXIT_CHECK_FAILED, str(error))
    except ArtifactError as error:
        return _fail(EXIT_REFUSED, str(error))
    except OSError as error:
        return _fail(EXIT_BAD_INPUT, str(error))
    except Exception as error:  # each stage has its own errors; errors of other libraries are raised again
        if not is_ours(error):
            raise
        return _fail(EXIT_BAD_INPUT, str(error))
    return EXIT_DONE


def _speaks() -> bool:
    """Return whether this process reports what all processes of torchrun do: the first."""
    return int(os.environ.get("RANK", "0")) == 0


def is_ours(error: Exception) -> bool:
    """Return whether an error is one of this repository's, whose text is a one-line message."""
    return type(error).__module__.startswith(PACKAGES)


def _main(args: argparse.Namespace) -> dict[str, Any]:
    recipe = check(args)
    steps = steps_of(args.command, recipe) if args.command != "card" else []
    if args.drives is not None:
        steps = [step for step in steps if step.stage != "collect" or not args.dry_run]
    before = chain.steps_until(args.after, recipe, steps) if args.after is not None else []
    if args.dry_run:
        steps = [step for step in steps if step not in before]
        plan = chain.budget_of(recipe, steps, args.device)
        sys.stderr.write("\n".join(chain.lines_of(recipe, steps, plan, args.device)) + "\n")
        return {"command": args.command, "recipe": recipe.name, "budget": chain.as_json(plan)}
    if args.command == "card":
        run_dir = RunDir(args.out)
        shipped = None if args.ship is None else str(ship(run_dir, recipe, args.ship, args.scores))
        return {"command": "card", "card": str(write_card(run_dir, recipe, args.scores)), "shipped": shipped}
    _check_device(args.device)
    with ranks_of_environment(args.device) as ranks, deterministic(args.device):
        return _train(args, recipe, steps, before, ranks)


def _check_device(device: str) -> None:
    import torch

    if device.startswith("cuda") and not torch.cuda.is_available():
        raise TrainError(f"--device {device}: not found on this machine, or torch was built without CUDA")


@contextmanager
def deterministic(device: str) -> Iterator[None]:
    """Enable deterministic operations on the CPU; operations without one raise RuntimeError."""
    import torch

    deterministic: Any = torch.utils.deterministic  # torch defines its attributes at run time
    before = torch.get_deterministic_debug_mode(), deterministic.fill_uninitialized_memory
    if device == "cpu":
        # As use_deterministic_algorithms(True), which would also load torch's compiler (a second).
        torch.set_deterministic_debug_mode("error")
        # No code reads memory before writing it; filling it only costs time.
        deterministic.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before[0])
        deterministic.fill_uninitialized_memory = before[1]


def _train(
    args: argparse.Namespace, recipe: Recipe, steps: Sequence[Step], before: Sequence[Step], ranks: Ranks
) -> dict[str, Any]:
    if ranks.world > 1 and not any(step.stage in chain.DISTRIBUTED for step in steps):
        shared = ", ".join((*chain.DISTRIBUTED, "dagger", "all"))
        raise TrainError(f"{args.command}: runs in one process; torchrun is for {shared}")
    run_dir = RunDir(args.out)
    with ranks.by_first() as here:
        if here:
            _prepare(args, recipe, before)
    results: dict[str, Any] = {}
    with stop_flag() as stop:
        for step in steps:
            # All ranks see the files of the first rank and agree on whether to stop.
            if ranks.any(stop.requested):
                raise KeyboardInterrupt
            if is_done(run_dir, step):
                _log(ranks, f"{step.name}: done before")
                results[step.name] = run_dir.result(step.name if step.stage == "dagger" else step.stage)
                continue
            may_begin(run_dir, step, args.resume)
            ranks.barrier()  # all ranks have checked before any starts
            results[step.name] = _step(args, recipe, run_dir, step, ranks, stop)
    if ranks.first and run_dir.model_path.is_file():
        write_card(run_dir, recipe)
    return {"command": args.command, "recipe": recipe.name, "out": str(args.out), "stages": results}


def _prepare(args: argparse.Namespace, recipe: Recipe, before: Sequence[Step]) -> None:
    """Write what a run needs before its first step: recipe, delay profile, given drives and given weights.

    If one is refused, what this call wrote into a new or empty folder is removed.
    """
    is_new, existed = not RunDir(args.out).recipe_path.exists(), args.out.exists()
    run_dir = RunDir.open(args.out, recipe)
    try:
        _take_given(args, recipe, before, run_dir)
    except BaseException:
        with suppress(OSError):  # the reason of the refusal is what the user must see
            for entry in list(args.out.iterdir()) if is_new else ():
                if entry.is_dir() and not entry.is_symlink():
                    shutil.rmtree(entry)
                else:
                    entry.unlink()
            if not existed:
                args.out.rmdir()
        raise


def _take_given(args: argparse.Namespace, recipe: Recipe, before: Sequence[Step], run_dir: RunDir) -> None:
    if run_dir.other_code():
        changed = f"{args.out}: was started with other code (versions.json); new drives may differ from its old ones"
        _log(SINGLE, f"{changed}; name another --out to record all of them anew")
    if args.delay_profile is not None:
        write_whole(*own_profile(args))
    if args.base is not None:
        run_dir.borrow(RunDir(args.base), BORROWED, recipe)
    if args.drives is not None:
        take_drives(run_dir, args.drives)
    if args.checkpoint:
        chain.take_start(run_dir, recipe, args.checkpoint, before)


def _step(
    args: argparse.Namespace, recipe: Recipe, run_dir: RunDir, step: Step, ranks: Ranks, stop: StopFlag
) -> dict[str, Any]:
    started_ns = time.monotonic_ns()
    try:
        with progress_for(step.name, quiet=not ranks.first) as progress:
            job = StageJob(
                recipe=recipe,
                run_dir=run_dir,
                resume=args.resume,
                device=args.device,
                progress=progress,
                seed=stage_seed(recipe, step.stage),
                ranks=ranks,
                stop=stop,
            )
            optim = getattr(getattr(recipe, step.stage, None), "optim", None)
            if getattr(optim, "bf16", False) and not computes_bf16(args.device):
                progress.log("using float32: this processor has no bfloat16 instructions")
            result = run_step(job, step) if step.stage in chain.DISTRIBUTED else _alone(job, step)
    finally:
        took_s = (time.monotonic_ns() - started_ns) / 1e9
        if ranks.first:
            run_dir.add_time(step.name, took_s)
    if ranks.first:
        draw_curves(run_dir)
    _log(ranks, f"{step.name}: done in {duration(took_s)}")
    return result


def _alone(job: StageJob, step: Step) -> dict[str, Any]:
    """Run a step in the first rank alone, with the threads of all ranks on this machine; the others wait."""
    import torch

    if job.ranks.world == 1:
        return run_step(job, step)
    threads = torch.get_num_threads()
    with job.ranks.by_first() as here:
        if here:
            torch.set_num_threads(threads * int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
            try:
                return run_step(replace(job, ranks=SINGLE), step)
            finally:
                torch.set_num_threads(threads)
    return job.run_dir.result(step.name if step.stage == "dagger" else step.stage) or {}


@contextmanager
def stop_flag() -> Iterator[StopFlag]:
    """Yield a flag that the first Ctrl-C or SIGTERM sets: the stage ends with a checkpoint. The second interrupts."""
    flag = StopFlag()

    def note(_number: int, _frame: FrameType | None) -> None:
        if flag.requested:
            raise KeyboardInterrupt
        flag.requested = True
        if _speaks():
            again = "press again to stop immediately"
            sys.stderr.write(f"{COMMAND}: stopping after this step, with a checkpoint; {again}\n")

    before: dict[int, Callable[[int, FrameType | None], Any] | int | None] = {
        number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _log(ranks: Ranks, line: str) -> None:
    if ranks.first:
        sys.stderr.write(f"{COMMAND}: {one_line(line)}\n")


def _fail(code: int, line: str) -> int:
    sys.stderr.write(f"{COMMAND}: {one_line(line)}\n")
    return code


if __name__ == "__main__":
    # Imported by name: `is_ours` would not recognise errors of the module `__main__`.
    from tools.train.cli import main as run

    if "WORLD_SIZE" in os.environ:
        leave(run())
    sys.exit(run())
