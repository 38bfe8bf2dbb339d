"""`edge-train`: train navigation weights from scratch, one stage at a time or all stages in order."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
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
    check_result_target,
    command_line,
    write_result,
    write_whole,
)
from edge.inference.latency_profile import load_profile
from reporting.progress import duration, peak_rss_bytes
from sim_hil.benchmark.runs import RunsError
from tools.train.config.checks import TrainError
from tools.train.config.recipe import VARIANTS, Recipe, load_recipe, recipe_names, stage_seed
from tools.train.pipeline import chain
from tools.train.pipeline.chain import Step, is_done, may_begin, run_step, steps_of
from tools.train.pipeline.model_card import ship, write_card
from tools.train.run.curves import draw_curves
from tools.train.run.distributed import SINGLE, Ranks, computes_bf16, leave, ranks_of_environment
from tools.train.run.job import StageFailedError, StageJob, StopFlag, progress_for
from tools.train.run.network_file import START, ExportError, import_start
from tools.train.run.run_dir import RunDir, take_drives

COMMAND: Final = "edge-train"
COMMANDS: Final = (*chain.ALL, "all", "card")
BORROWED: Final = ("collect", "encoder", "sft")
"""Stages that --from takes from another run: those that do not depend on the action expert."""
PACKAGES: Final = ("calib.", "edge.", "export.", "sim_hil.", "tools.")
"""Packages whose errors carry a one-line message for the user."""

EXAMPLES: Final = """examples:
  edge-train all --preset nano --out out/nano-run --dry-run        print the steps and their estimated duration
  edge-train all --preset nano --out out/nano-run                  all stages; Ctrl-C interrupts, --resume continues
  edge-train collect --preset nano --out out/run                   a single stage
  edge-train sft --out out/run --set sft.epochs=12
  torchrun --nproc-per-node 2 -m tools.train.cli sft --out out/run           also: encoder, imitate, dagger, all
  edge-train imitate --out out/run --delay-profile orin.latency.json
  edge-train imitate --from out/run --variant no-latency --out out/no-latency
  edge-train dagger --preset nano --checkpoint out/run/model.safetensors --after imitate --out out/more
  edge-train card --out out/run --scores out/bench/result.json --ship export/weights    model card, weights to publish

stages: collect (the expert drives), encoder (vision encoder on simulator labels), sft (reasoning text and waypoints),
imitate (actions under delay), dagger (the policy drives, the expert relabels, imitation continues), rl (PPO),
evaluate (episodes in layouts that no stage has used)
exit codes: 0 done, 1 an export, a drive or an episode failed, 2 bad arguments or input, 3 refused (artifacts),
            130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Build the command line of `edge-train`."""
    p = argparse.ArgumentParser(
        COMMAND, description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("command", choices=COMMANDS, metavar="STAGE", help=", ".join(COMMANDS))
    which = p.add_mutually_exclusive_group()
    which.add_argument(
        "--preset", metavar="NAME", help=f"recipe: {', '.join(recipe_names())} (default: the run's, or nano)"
    )
    which.add_argument("--recipe", type=Path, metavar="FILE.toml", help="recipe file")
    p.add_argument(
        "--set", dest="settings", metavar="KEY=VALUE", action="append", default=[],
        help="change a value of the recipe: seed, STAGE.field or model.SECTION.field; repeatable",
    )  # fmt: skip
    p.add_argument(
        "--variant",
        choices=VARIANTS,
        metavar="NAME",
        help=f"an ablation or baseline of the paper: {', '.join(VARIANTS)}",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="run folder")
    p.add_argument("--resume", action="store_true", help="continue an interrupted stage; finished stages are skipped")
    p.add_argument(
        "--drives",
        type=Path,
        metavar="DIR",
        help="train on this data set (tools.train.importers) instead of collecting",
    )
    p.add_argument("--from", dest="base", type=Path, metavar="DIR", help=f"reuse {', '.join(BORROWED)} of another run")
    p.add_argument(
        "--checkpoint", type=Path, metavar="PATH", action="append", default=[],
        help="initial weights, such as a backbone's (in a format that edge-export reads); repeatable",
    )  # fmt: skip
    p.add_argument(
        "--after",
        metavar="STEP",
        help="treat the weights of --checkpoint as the result of this step; continue after it",
    )
    p.add_argument("--device", default="cpu", metavar="cpu|cuda", help="device that trains the networks (default: cpu)")
    p.add_argument("--delay-profile", type=Path, metavar="FILE", help="train with these delays (edge-calib latency)")
    p.add_argument(
        "--scores", type=Path, metavar="FILE", action="append", default=[], help="card: edge-bench's result.json"
    )
    p.add_argument("--ship", type=Path, metavar="DIR", help="card: also write the weights for publication there")
    p.add_argument("--dry-run", action="store_true", help="print the steps and their estimated duration, then exit")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line("edge-train")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    try:
        result = _main(args)
        result["peak_rss_bytes"] = peak_rss_bytes()
        result["wall_s"] = round((time.monotonic_ns() - started_ns) / 1e9, 3)
        if int(os.environ.get("RANK", "0")) == 0:
            write_result(args.json, result)
    except KeyboardInterrupt:
        again = "; continue with --resume" if args.out is not None else ""
        return _fail(EXIT_INTERRUPTED, f"interrupted, finished work is kept{again}")
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


def is_ours(error: Exception) -> bool:
    """Return whether an error is one of this repository's, whose text is a one-line message."""
    return type(error).__module__.startswith(PACKAGES)


def _main(args: argparse.Namespace) -> dict[str, Any]:
    check_result_target(args.json)
    recipe = _recipe(args)
    steps = steps_of(args.command, recipe) if args.command != "card" else []
    if args.drives is not None:
        if args.command == "card":
            raise TrainError("--drives belongs to stages, not to card")
        steps = [step for step in steps if step.stage != "collect" or not args.dry_run]
    if args.dry_run:
        plan = chain.budget_of(recipe, steps, args.device)
        sys.stderr.write("\n".join(chain.lines_of(recipe, steps, plan, args.device)) + "\n")
        return {"command": args.command, "recipe": recipe.name, "budget": chain.as_json(plan)}
    if args.out is None:
        raise TrainError("--out is missing: expected the folder of the run, e.g. --out out/run")
    if args.command == "card":
        run_dir = RunDir(args.out)
        shipped = None if args.ship is None else str(ship(run_dir, recipe, args.ship, args.scores))
        return {"command": "card", "card": str(write_card(run_dir, recipe, args.scores)), "shipped": shipped}
    if args.scores or args.ship:
        raise TrainError("--scores and --ship belong to card")
    if args.base is not None and args.checkpoint:
        raise TrainError("--from and --checkpoint: expected one of them, both name the initial weights")
    if args.base is not None and args.drives is not None:
        raise TrainError("--from and --drives: expected one of them, both name the drives")
    if args.after is not None and args.drives is not None:
        raise TrainError("--after and --drives: expected one of them, --after continues without earlier drives")
    if args.after is not None and not args.checkpoint:
        raise TrainError("--after: expected --checkpoint with it, the weights that the step wrote")
    before = chain.steps_until(args.after, recipe, steps) if args.after is not None else []
    _check_device(args.device)
    with ranks_of_environment(args.device) as ranks, deterministic(args.device):
        return _train(args, recipe, steps, before, ranks)


def _recipe(args: argparse.Namespace) -> Recipe:
    """Load the named recipe, else the recipe of the run in --out or --from, else nano."""
    # Implied settings come first, so that --set overrides them. No drives are added to another run's.
    implied = ["dagger.rounds=0"] if args.base is not None else []
    settings = [*implied, *VARIANTS[args.variant or "full"], *args.settings]
    if args.delay_profile is not None:
        path, _ = _own_profile(args)
        # Started stages keep their profile: `rl` alone does not change imitation's, nor the other way round.
        settings += [f"imitate.delays.profile={path}"] if args.command != "rl" else []
        settings += [f"rl.delay_profile={path}"] if args.command != "imitate" else []
    there = [folder / "recipe.toml" for folder in (args.out, args.base) if folder is not None]
    found = next((path for path in there if path.is_file()), None)
    if args.preset is not None and args.preset not in recipe_names():
        raise TrainError(f"--preset {args.preset}: expected one of {', '.join(recipe_names())}; a file is a --recipe")
    if args.recipe is not None and args.recipe.suffix != ".toml":
        raise TrainError(f"--recipe {args.recipe}: expected a file that ends in .toml")
    if args.command == "card" and found is None:
        raise TrainError("card: expected --out to be the folder of a run")
    return load_recipe(str(args.preset or args.recipe or found or "nano"), settings)


def _own_profile(args: argparse.Namespace) -> tuple[Path, str]:
    """Return (path, content) of the run's own copy of --delay-profile; its name contains the hash of its content.

    Without a copy, a resumed run would silently train with other delays after the file was measured again.
    """
    content = json.dumps(load_profile(args.delay_profile).as_json()) + "\n"
    if args.out is None:
        return args.delay_profile.absolute(), content
    return args.out.absolute() / f"delays-{hashlib.sha256(content.encode()).hexdigest()[:12]}.json", content


def _check_device(device: str) -> None:
    import torch

    kind, _, number = device.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdecimal()) or (kind == "cpu" and number):
        raise TrainError(f"--device {device}: expected cpu, cuda or cuda:N")
    if kind == "cuda" and not torch.cuda.is_available():
        raise TrainError(f"--device {device}: not found on this machine, or torch was built without CUDA")


@contextmanager
def deterministic(device: str) -> Iterator[None]:
    """Enable deterministic operations on the CPU; operations without one raise RuntimeError."""
    import torch

    deterministic: Any = torch.utils.deterministic  # torch defines its attributes at run time
    before = torch.are_deterministic_algorithms_enabled(), deterministic.fill_uninitialized_memory
    if device == "cpu":
        torch.use_deterministic_algorithms(True)
        # No code reads memory before writing it; filling it only costs time.
        deterministic.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0])
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
    """Write what a run needs before its first step: recipe, delay profile, given drives and given weights."""
    run_dir = RunDir.open(args.out, recipe)
    if args.delay_profile is not None:
        write_whole(*_own_profile(args))
    if args.base is not None:
        run_dir.borrow(RunDir(args.base), BORROWED, recipe)
    if args.drives is not None:
        take_drives(run_dir, args.drives)
    if args.checkpoint and not run_dir.begun(START):
        import_start(run_dir.out, recipe.model, args.checkpoint, recipe.seed)
        if before:
            chain.adopt(run_dir, before)


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
        sys.stderr.write(f"{COMMAND}: stopping after this step, with a checkpoint; press again to stop immediately\n")

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
        sys.stderr.write(f"{COMMAND}: {line}\n")


def _fail(code: int, line: str) -> int:
    sys.stderr.write(f"{COMMAND}: {line}\n")
    return code


if __name__ == "__main__":
    # Imported by name: `is_ours` would not recognise errors of the module `__main__`.
    from tools.train.cli import main as run

    if "WORLD_SIZE" in os.environ:
        leave(run())
    sys.exit(run())
