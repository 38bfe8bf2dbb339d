"""`edge-calib latency`: measures generation times beside a control thread; writes a latency profile."""

from __future__ import annotations

import argparse
import datetime
import json
import math
import threading
from pathlib import Path
from typing import Any, Final

from calib.latency_load import Measured, MeasureError, measure
from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    messages,
    write_named,
    write_result,
)
from edge.core.device import read_device
from edge.core.stats import percentiles
from edge.inference.engines import EngineError, with_built_engines
from edge.inference.graph import GraphError
from edge.inference.latency_profile import LatencyError, LatencyProfile, load_profile
from edge.power.meters.meter import MEASURED
from edge.reasoning.generation_cycle import Mode
from edge.reasoning.prompt import InstructionError, check_instruction
from export.evaluation.calibration import CalibrationError, load_calibration

LEAST: Final = 20
"""Smallest number of generations of a profile: fewer contain too few slow ones."""
INSTRUCTION: Final = "walk down the corridor and stop at the vending machine"

EXAMPLES: Final = """examples:
  edge-calib latency --artifacts out/nano --out orin.latency.json       measure on this device, control ticks beside it
  edge-calib latency --log flight.mcap --out orin.latency.json          ... or take what a run has recorded
  edge-calib latency --log orin.latency.json --scale-to-mean 2 --out 2s.latency.json
  edge-bench --suite dynanav --policy artifacts:out/nano --latency profile:orin.latency.json
  edge-train imitate --out out/train --delay-profile orin.latency.json
Leave the device alone meanwhile, in the power mode that it will drive in. A measurement that fails writes nothing.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the job."""
    parser.epilog = EXAMPLES
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--artifacts", type=Path, metavar="DIR", help="artifacts to run on this device")
    source.add_argument("--log", type=Path, metavar="FILE", help="flight log, edge-run result or profile to take")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json", help="profile to write")
    parser.add_argument("--generations", type=int, default=100, metavar="N", help="to measure (default: 100)")
    parser.add_argument("--seconds", type=float, default=600.0, metavar="S", help="at most (default: 600)")
    parser.add_argument(
        "--mode", choices=[Mode.ASYNC.value, Mode.NO_REASONING.value], default=Mode.ASYNC.value, help="(default: async)"
    )
    parser.add_argument("--instruction", default=INSTRUCTION, metavar="TEXT", help="instruction of the prompts")
    parser.add_argument(
        "--calibration", default="corridor-go2", metavar="NAME", help="pictures it sees (default: corridor-go2)"
    )
    parser.add_argument("--scale-to-mean", type=float, metavar="S", help="same shape with this mean; tagged modelled")
    parser.add_argument("--machine", metavar="NAME", help="what to call this device (default: its board or processor)")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")


_print = messages("edge-calib latency")
_BAD_INPUT = (ArtifactError, GraphError, LatencyError, CalibrationError, InstructionError, OSError, ValueError)


@command_line(
    "edge-calib latency",
    {MeasureError: EXIT_CHECK_FAILED, EngineError: EXIT_REFUSED, **dict.fromkeys(_BAD_INPUT, EXIT_BAD_INPUT)},
)
def run(args: argparse.Namespace) -> int:
    """Measure generation times or read them from a log, write the profile and return the exit code."""
    _check(args)
    profile, measured = _measured(args) if args.artifacts is not None else (load_profile(args.log), None)
    if args.scale_to_mean is not None:
        profile = profile.scaled_to_mean(args.scale_to_mean)
    if len(profile.generation_s) < LEAST:
        raise MeasureError(f"{len(profile.generation_s)} generations, expected {LEAST} or more: give it more --seconds")
    write_named(args.out, json.dumps(profile.as_json(), indent=1) + "\n")
    result = summary(profile, args.out, measured)
    write_result(args.json, result)
    generation = result["generation_s"]
    _print(
        f"{result['generations']} generations, mean {result['mean_s']:.3f} s, p50 {generation['p50']:.3f} s, "
        f"p99 {generation['p99']:.3f} s, max {generation['max']:.3f} s ({profile.tagged})"
    )
    if profile.call_s:
        calls = ", ".join(f"{rows}: {1e3 * time_s:.2f}" for rows, time_s in profile.call_s)
        _print(f"decoding calls by number of rows, ms: {calls}")
    if measured is not None:
        _print(f"control beside it: {measured.ticks} ticks, {measured.late} of them late")
    _print(f"wrote {args.out}: edge-bench --latency profile:{args.out}, edge-train --delay-profile {args.out}")
    return EXIT_DONE


def _check(args: argparse.Namespace) -> None:
    check_result_target(args.json)
    check_result_target(str(args.out), "--out")
    if args.out.suffix != ".json":
        raise ValueError(f"--out {args.out}: expected a file name that ends in .json")
    if not args.out.absolute().parent.is_dir():
        raise ValueError(f"--out {args.out}: there is no directory {args.out.parent}")
    if not LEAST <= args.generations <= 100_000:
        raise ValueError(f"--generations {args.generations}: expected {LEAST} to 100000")
    if not (math.isfinite(args.seconds) and 1 <= args.seconds <= 86_400):
        raise ValueError(f"--seconds {args.seconds:g}: expected 1 to 86400")
    if args.scale_to_mean is not None and not (math.isfinite(args.scale_to_mean) and 0 < args.scale_to_mean <= 600):
        raise ValueError(f"--scale-to-mean {args.scale_to_mean:g}: expected more than 0 and at most 600 s")
    check_instruction(args.instruction)


def _measured(args: argparse.Namespace) -> tuple[LatencyProfile, Measured]:
    artifacts = with_built_engines(load_artifacts(args.artifacts.absolute()))
    if args.mode == Mode.NO_REASONING.value and artifacts.guided_by_waypoints:
        raise ValueError(f"--mode {args.mode}: {args.artifacts} is guided by the waypoints that reasoning writes")
    clip = load_calibration(args.calibration).clips[0]
    stop = threading.Event()
    measured = measure(
        artifacts,
        clip,
        instruction=args.instruction,
        mode=Mode(args.mode),
        generations=args.generations,
        seconds=args.seconds,
        say=_print,
        stop=stop,
    )
    machine = args.machine or read_device(artifacts.graphs["vision_encoder"].session.provider).device
    date = datetime.date.today().isoformat()
    times, anchors = zip(*measured.times_s, strict=True) if measured.times_s else ((), ())
    source = (
        f"edge-calib latency: {artifacts.model_name} on {machine}, {date}, {args.mode}, control ticks every "
        f"{artifacts.runtime.tick_period_ms} ms beside it, {'trained' if artifacts.trained else 'untrained'} weights"
    )
    if not times:
        raise MeasureError("no generation was finished: give it more --seconds")
    call_s = measured.call_s
    rest_s = tuple(
        time_s - decoding.after_first_s for time_s, decoding in zip(times, measured.decoding, strict=True) if call_s
    )
    return LatencyProfile(machine, source, times, anchors, MEASURED, call_s, rest_s), measured


def summary(profile: LatencyProfile, out: Path, measured: Measured | None) -> dict[str, Any]:
    """What `--json` writes."""
    times = list(profile.generation_s)
    return {
        "out": str(out),
        "name": profile.name,
        "source": profile.source,
        "generations": len(times),
        "mean_s": profile.mean_s,
        "generation_s": percentiles(times, "p50", "p99", "max"),
        "anchor_after_s": percentiles(list(profile.anchor_after_s), "p50", "p99", "max"),
        "call_s": {str(rows): time_s for rows, time_s in profile.call_s},
        "control": None if measured is None else {"ticks": measured.ticks, "late": measured.late},
        "failed": 0 if measured is None else measured.failed,
        "tagged": profile.tagged,
    }
