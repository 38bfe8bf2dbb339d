"""The target plan's roofline against every measurement there is: residuals, the worst assumption, and intervals.

    python -m tools.bench.roofline
    python -m tools.bench.roofline --json out/bench/roofline.json

Each row of `tools/bench/roofline.toml` is a measurement with its device's peaks. The model predicts it without the
target's own measured points. `ratio` is measured time over predicted time: 1 is exact, above 1 the device was slower.
Ratios of rows that no figure was fitted to, by what bounds the time, widen the error bar of a prediction.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_DONE, check_result_target, command_line, write_result
from export.core.typed import FieldError, build
from export.model.config import PRESETS, LanguageConfig, TicVlaConfig
from export.plan.plan import plan
from export.plan.timing import GENERATION_STAGES, TICK_STAGES, Estimate, StageTime, Work, modelled_stage, total
from export.quantize.precision import Precision
from export.targets.file import Target, load_target, with_settings
from export.targets.sections import MODELLED, STAGES, TargetError
from firmware_bridge.system.input_file import read_toml
from tools.bench import bad_input, command_parser

ROWS: Final = Path(__file__).with_suffix(".toml")
MAX_BYTES: Final = 1_000_000
KINDS: Final = ("fitted", "ours", "published", "other-software")
COUNTED: Final = ("ours", "published")
"""Kinds whose ratios give the intervals."""
SUMS: Final = {"tick": TICK_STAGES, "generation": GENERATION_STAGES}
PREDICTED: Final = ("orin", "rtx4060")


@dataclass(frozen=True)
class Measurement:
    """One measured time, or rate of decoding, with the device's peaks as settings of a target."""

    name: str
    kind: str
    target: str
    stage: str
    """A stage of the plan, or `tick` or `generation` for the sum of theirs."""
    precision: str
    source: str
    settings: tuple[str, ...] = ()
    model: str = "1b"
    overrides: Mapping[str, str] = field(default_factory=dict)
    prompt: int = 1100
    new: int = 1
    ms: float | None = None
    tokens_per_s: float | None = None
    assumed: str = ""
    """What the source does not state."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FieldError(f"kind {self.kind!r}: expected one of {', '.join(KINDS)}")
        if self.stage not in (*STAGES, *SUMS):
            raise FieldError(f"stage {self.stage!r}: expected one of {', '.join((*STAGES, *SUMS))}")
        if (self.ms is None) == (self.tokens_per_s is None) or not self.measured_ms > 0:
            raise FieldError(f"{self.name}: expected either ms or tokens_per_s, above 0")

    @property
    def measured_ms(self) -> float:
        """Measured time, ms; of decoding, per token."""
        return self.ms if self.ms is not None else 1e3 / (self.tokens_per_s or math.nan)


@dataclass(frozen=True)
class Residual:
    """A measurement beside its prediction."""

    measurement: Measurement
    predicted: Estimate
    bound: str
    """What bounds most of the predicted time: `compute` or `memory`."""
    assumption: str
    """The figure that the prediction depends on most, with its source."""

    @property
    def ratio(self) -> float:
        """Measured over predicted time."""
        return self.measurement.measured_ms / self.predicted.ms

    @property
    def inside(self) -> bool:
        """Whether the measurement is within the prediction's own error bar."""
        return abs(self.ratio - 1) <= (self.predicted.error or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            **asdict(self.measurement),
            "measured_ms": self.measurement.measured_ms,
            "predicted_ms": self.predicted.ms,
            "error": self.predicted.error,
            "ratio": self.ratio,
            "inside": self.inside,
            "bound": self.bound,
            "assumption": self.assumption,
        }


def load_rows(path: Path = ROWS) -> tuple[list[Measurement], dict[str, TicVlaConfig]]:
    """Return the measurements and the networks that they name. Raises FieldError or OSError."""
    content = read_toml(path, MAX_BYTES)
    configs = dict(PRESETS)
    for name, numbers in content.get("models", {}).items():
        language = build(LanguageConfig, numbers, f"models.{name}")
        vision = replace(PRESETS["1b"].vision, token_dim=language.hidden)
        configs[name] = replace(PRESETS["1b"], name=name, language=language, vision=vision)
    rows = [build(Measurement, row, f"row {number}") for number, row in enumerate(content.get("row", []), 1)]
    for row in rows:
        if row.model not in configs:
            raise FieldError(f"{row.name}: model {row.model!r}: expected one of {', '.join(sorted(configs))}")
    return rows, configs


def predict(measurement: Measurement, config: TicVlaConfig) -> Residual:
    """Model one measurement. Raises TargetError for settings that the target does not have."""
    base = "1b" if measurement.model not in PRESETS else measurement.model
    target = with_settings(load_target(measurement.target, base), measurement.settings)
    precision = Precision(measurement.precision, tuple(measurement.overrides.items()))
    work = Work(measurement.prompt, target.runtime.prefill_chunk_tokens, measurement.new)
    names = SUMS.get(measurement.stage, (measurement.stage,))
    stages = [modelled_stage(target, config, name, precision, work) for name in names]
    longest = max(stages, key=lambda stage: stage.whole.ms)
    whole = total([stage.whole for stage in stages])
    return Residual(measurement, whole, longest.bound, assumption(target, longest))


def assumption(target: Target, stage: StageTime) -> str:
    """Return the efficiency that bounds a stage, with its source."""
    roofline = target.roofline
    if stage.bound == "memory":
        name, figure = "memory_efficiency", roofline.memory_efficiency
    else:
        name, figure = f"compute_efficiency.{stage.stage}", roofline.compute_efficiency[stage.stage]
    return f"{name} = {figure.value:g} ({figure.source})"


@dataclass(frozen=True)
class Interval:
    """Smallest and largest ratio of `count` counted measurements."""

    low: float
    high: float
    count: int


def intervals(residuals: Sequence[Residual]) -> dict[str, Interval]:
    """Return the interval of a prediction by what bounds its time; without a measurement there is none."""
    found: dict[str, Interval] = {}
    for bound in ("compute", "memory"):
        ratios = [r.ratio for r in residuals if r.bound == bound and r.measurement.kind in COUNTED]
        if ratios:
            found[bound] = Interval(min(ratios), max(ratios), len(ratios))
    return found


def worst(residuals: Sequence[Residual]) -> dict[str, Residual]:
    """Return by target the counted residual that is furthest from 1."""
    found: dict[str, Residual] = {}
    for r in sorted(residuals, key=lambda r: abs(math.log(r.ratio))):
        if r.measurement.kind in COUNTED:
            found[r.measurement.target] = r
    return found


def predictions(by_bound: Mapping[str, Interval]) -> list[dict[str, Any]]:
    """Return tick and generation of the shipped targets at paper size, ms: own error bars and intervals together."""
    found: list[dict[str, Any]] = []
    for name in PREDICTED:
        stages = {stage.stage: stage for stage in plan(load_target(name, "1b"), PRESETS["1b"]).stages}
        for what, parts in SUMS.items():
            low = high = ms = 0.0
            for stage in (stages[part] for part in parts):
                interval, error = by_bound.get(stage.bound, Interval(1.0, 1.0, 0)), stage.whole.error or 0.0
                ms += stage.whole.ms
                low += stage.whole.ms * min(1.0 - error, interval.low)
                high += stage.whole.ms * max(1.0 + error, interval.high)
            found.append({"target": name, "what": what, "ms": ms, "low_ms": low, "high_ms": high, "tagged": MODELLED})
    return found


def markdown(residuals: Sequence[Residual], by_bound: Mapping[str, Interval], made: Sequence[dict[str, Any]]) -> str:
    """Format the residuals, the worst assumption and the predictions."""
    lines = ["| measurement | kind | bound by | measured, ms | predicted, ms | ratio |", "|---|---|---|---:|---:|---:|"]
    for r in residuals:
        error = f" ± {100 * r.predicted.error:.0f} %" if r.predicted.error else ""
        lines.append(
            f"| {r.measurement.name} | {r.measurement.kind} | {r.bound} | {r.measurement.measured_ms:.4g} | "
            f"{r.predicted.ms:.4g}{error} | {r.ratio:.2f}{'' if r.inside else ' (outside)'} |"
        )
    lines += [""]
    lines += [
        f"Worst assumption of {target}: {r.assumption}; {r.measurement.name}: ratio {r.ratio:.2f}."
        for target, r in worst(residuals).items()
    ]
    lines += [f"Interval, {b} bound: {i.low:.2f} to {i.high:.2f} ({i.count} rows)." for b, i in by_bound.items()]
    lines += ["", "| prediction (modelled) | ms | interval, ms |", "|---|---:|---|"]
    lines += [
        f"| {p['target']}, {p['what']} alone | {p['ms']:.0f} | {p['low_ms']:.0f} to {p['high_ms']:.0f} |" for p in made
    ]
    return "\n".join(lines)


@command_line("roofline")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__)
    p.add_argument("--rows", type=Path, default=ROWS, metavar="FILE.toml", help="measurements (default: ours)")
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        rows, configs = load_rows(args.rows)
        residuals = [predict(row, configs[row.model]) for row in rows]
        if not any(r.measurement.kind in COUNTED for r in residuals):
            raise FieldError(f"{args.rows}: expected rows of kind {' or '.join(COUNTED)}, found none")
        by_bound = intervals(residuals)
        made = predictions(by_bound)
        result = {
            "residuals": [r.to_dict() for r in residuals],
            "intervals": {bound: asdict(interval) for bound, interval in by_bound.items()},
            "worst": {target: r.to_dict() for target, r in worst(residuals).items()},
            "predictions": made,
            "tagged": MODELLED,
        }
        write_result(args.json, result)
    except (FieldError, TargetError, ValueError, OSError) as error:
        return bad_input("roofline", error)
    if args.json != "-":
        print(markdown(residuals, by_bound, made))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
