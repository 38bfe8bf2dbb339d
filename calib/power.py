"""`edge-calib power`: what the device draws at rest, in every stage and in a run; fits the plan's energy model."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import tomli_w

from calib.power_fit import Fit, FitError, Phase, fit_energy
from calib.power_load import Counts, EnergyLog, Load, run_phases
from edge.artifacts.files import ArtifactError, read_manifest
from edge.artifacts.manifest import Artifacts, load_artifacts
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
from edge.core.sysfs import SYSFS
from edge.inference.engines import EngineError, with_built_engines
from edge.inference.graph import GraphError
from edge.power.governor.plan import STAGES, PowerModel, PowerPlan, read_power_plan
from edge.power.meters.meter import MEASURED, MODELLED, MeterError, ModelledMeter, PowerMeter
from edge.power.meters.select import open_meter
from export.core.typed import plain
from export.plan.timing import measured_point
from export.targets.file import Target, parse_target
from export.targets.sections import Figure, Measured, TargetError
from firmware_bridge.system.input_file import parse_toml

METERS: Final = ("target", "auto", "ina3221", "nvml", "rapl", "modelled")

EXAMPLES: Final = """examples:
  edge-calib power --artifacts out/nano --out orin.power.toml     measure, fit, write a target with measured figures
  edge-export --target orin.power.toml --model nano --out out/x   ... which the exporter then plans with
  edge-calib power --artifacts out/nano --meter modelled          dry run on the plan's own figures, writes no target
Leave the device alone meanwhile, in the power mode that the target names (edge-doctor shows it).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the job."""
    parser.epilog = EXAMPLES
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="artifacts to run")
    parser.add_argument("--out", type=Path, metavar="FILE.toml", help="write their target with the measured figures")
    parser.add_argument("--meter", choices=METERS, default="target", help="power meter (default: the target's)")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="length of a phase (default: 20)")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="times that all phases run (default: 3)")
    parser.add_argument("--machine", metavar="NAME", help="what to call this device (default: its board or processor)")
    parser.add_argument("--json", metavar="FILE|-", help="write the fit and every phase")


_print = messages("edge-calib power")
_BAD_INPUT = (ArtifactError, GraphError, TargetError, KeyError, OSError, ValueError)


@command_line(
    "edge-calib power",
    {
        MeterError: EXIT_REFUSED,
        EngineError: EXIT_REFUSED,
        FitError: EXIT_CHECK_FAILED,
        **dict.fromkeys(_BAD_INPUT, EXIT_BAD_INPUT),
    },
)
def run(args: argparse.Namespace, sysfs_root: Path = SYSFS) -> int:
    """Measure, fit, write; returns the exit code."""
    check_result_target(args.json)
    _check(args)
    artifacts = with_built_engines(load_artifacts(args.artifacts.absolute()))
    power = read_power_plan(artifacts)
    manifest = read_manifest(args.artifacts)
    target = parse_target(manifest["provenance"]["target"], f"{args.artifacts}: the target in its manifest")
    counts = Counts()
    meter = _meter(args.meter, power, counts, sysfs_root)
    result, written = _calibrate(args, artifacts, manifest, target, meter, counts)
    write_result(args.json, result)
    for line in result["weak"]:
        _print(line)
    if result["weak"]:
        raise FitError("nothing was written: run it again with longer --seconds on an idle device")
    if written:
        _print(f"wrote {args.out}: edge-export --target {args.out} plans with it")
    elif result["tagged"] == MODELLED:
        _print("modelled: a dry run on the plan's own figures, no target was written")
    return EXIT_DONE


def _check(args: argparse.Namespace) -> None:
    if not 0.2 <= args.seconds <= 3600:
        raise ValueError(f"--seconds {args.seconds:g}: expected 0.2 to 3600")
    if not 2 <= args.rounds <= 100:
        raise ValueError(f"--rounds {args.rounds}: expected 2 to 100, one round cannot tell noise from the fit")
    if args.out is not None and args.out.suffix != ".toml":
        raise ValueError(f"--out {args.out}: expected a file name that ends in .toml")
    if args.out is not None:
        check_result_target(str(args.out), "--out")


def _meter(kind: str, power: PowerPlan, counts: Counts, sysfs_root: Path) -> PowerMeter:
    model = power.model
    if kind == "modelled" and model is not None:
        return ModelledMeter(model.idle_w, lambda: _modelled_j(model, counts.copy()))
    return open_meter(power.meter if kind == "target" else kind, sysfs_root=sysfs_root, rail=power.rail)


def _modelled_j(model: PowerModel, done: Mapping[str, float]) -> float:
    joules = (model.encode_j, model.act_j, model.prefill_j, model.token_j, model.context_j)
    return sum(done[stage] * each for stage, each in zip(STAGES, joules, strict=True))


def _calibrate(
    args: argparse.Namespace,
    artifacts: Artifacts,
    manifest: Mapping[str, Any],
    target: Target,
    meter: PowerMeter,
    counts: Counts,
) -> tuple[dict[str, Any], bool]:
    """(result, whether a target was written)."""
    _print(f"meter: {meter.source}{f' ({meter.caveat})' if meter.caveat else ''}")
    load = Load(artifacts, counts)
    phases = run_phases(load, counts, EnergyLog(meter), seconds=args.seconds, rounds=args.rounds, say=_print)
    fit = fit_energy(phases)
    modelled = isinstance(meter, ModelledMeter)
    machine = args.machine or read_device(artifacts.graphs["vision_encoder"].session.provider).device
    date = datetime.date.today().isoformat()
    written = False
    if args.out is not None and not fit.weak and not modelled:
        lengths = {"prompt": load.prompt_tokens, "new": load.new_tokens, **stage_ms(phases)}
        points = [
            measured_point(
                target, manifest, artifacts, stage, lengths, machine=machine, date=date, energy_j=fit.stage_j[stage]
            )
            for stage in STAGES
            if lengths[stage]
        ]
        where = f"edge-calib power: {meter.source}, {machine}, {date}"
        write_named(args.out, target_text(measured_target(target, fit, phases, points, where)))
        written = True
    _report(fit)
    result = {
        "artifacts": str(artifacts.directory),
        "machine": machine,
        "date": date,
        "mode": target.power.mode,
        "meter": meter.source,
        "caveat": meter.caveat,
        "fit": fit.to_dict(),
        "weak": list(fit.weak),
        "phases": [{**dataclasses.asdict(phase), "power_w": phase.power_w} for phase in phases],
        "stage_ms": stage_ms(phases),
        "prompt_tokens": load.prompt_tokens,
        "out": str(args.out) if written else None,
        "tagged": MODELLED if modelled else MEASURED,
    }
    return result, written


def stage_ms(phases: Sequence[Phase]) -> dict[str, list[float]]:
    """Time of one unit of each stage in ms, one value a round.

    A token's is a generation's beyond its prompt, an action's a tick's beyond its semantic context, if it contains one.
    """
    times: dict[str, list[float]] = {stage: [] for stage in STAGES}
    prefill_s = context_s = 0.0
    for phase in phases:
        if phase.name not in STAGES or not phase.counts.get(phase.name):
            continue
        seconds = phase.seconds
        if phase.name == "prefill":
            prefill_s = seconds / phase.counts["prefill"]
        if phase.name == "semantic_context":
            context_s = seconds / phase.counts["semantic_context"]
        if phase.name == "decode":
            seconds -= prefill_s * phase.counts.get("prefill", 0.0)
        if phase.name == "action_expert":
            seconds -= context_s * phase.counts.get("semantic_context", 0.0)
        if seconds > 0:
            times[phase.name].append(1e3 * seconds / phase.counts[phase.name])
    return times


def measured_target(
    target: Target, fit: Fit, phases: Sequence[Phase], points: Sequence[Measured], where: str
) -> Target:
    """The target with idle power, full load and stages as measured; older points of the same stages are replaced."""
    busiest = max(phases, key=lambda phase: phase.power_w)
    mode = target.power.selected
    relative = min(0.99, fit.idle_error_w / fit.idle_w) if fit.idle_w > 0 else 0.99
    idle = Figure(round(fit.idle_w, 4), where, MEASURED, round(relative, 4))
    busy = Figure(round(busiest.power_w, 4), f"{where}: the most of any phase ({busiest.name})", MEASURED)
    modes = {**target.power.modes, target.power.mode: dataclasses.replace(mode, busy_w=busy)}
    new = {(point.model, point.graph, point.tokens_per_s is None) for point in points}
    kept = [p for p in target.measured if (p.model, p.graph, p.tokens_per_s is None) not in new]
    return dataclasses.replace(
        target,
        description=f"{target.description}; power as measured on {points[0].machine}" if points else target.description,
        power=dataclasses.replace(target.power, idle_w=idle, modes=modes),
        measured=(*kept, *points),
    )


def target_text(target: Target) -> str:
    """The target as a file that the exporter reads back as the same target; raises TargetError if it would not."""
    content = target.to_dict()
    content["measured"] = [{k: v for k, v in plain(point).items() if v != {}} for point in target.measured]
    text = "# Written by edge-calib power. Figures tagged measured are this device's.\n" + tomli_w.dumps(content)
    if parse_target(parse_toml(text), target.name) != target:
        raise TargetError(f"{target.name}: cannot be written as a file that reads back as the same target")
    return text


def _report(fit: Fit) -> None:
    _print(f"idle {fit.idle_w:.2f} ± {fit.idle_error_w:.2f} W")
    for stage in STAGES:
        unit = {"prefill": "prompt", "decode": "token"}.get(stage, "call")
        _print(f"{stage} {fit.stage_j[stage]:.4g} ± {fit.error_j[stage]:.2g} J a {unit}")
    _print(f"explains {100 * fit.r2:.1f} % of the variation, misses unfitted mixtures by {100 * fit.check_error:.1f} %")
