"""Estimate of a run's work before it starts: samples of each stage, and duration from measured throughputs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from reporting.progress import duration
from tools.train.collect import collect
from tools.train.config.collect import OF_TOURS
from tools.train.config.recipe import Recipe
from tools.train.encoder import encoder
from tools.train.imitate import imitate
from tools.train.pipeline.chain import Step
from tools.train.rl import rl
from tools.train.run.optim import computes_bf16
from tools.train.sft import sft

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Work = list[tuple[str, int, str]]
"""(description, number of samples, key in the throughput table) of each kind of work."""

BUDGETS: Final[Mapping[str, Callable[[Recipe], Work]]] = {
    "collect": collect.budget,
    "encoder": encoder.budget,
    "sft": sft.budget,
    "imitate": imitate.budget,
    "rl": rl.budget,
}
"""Function of each stage that returns its work; `evaluate` and `dagger` are computed here."""
FILE: Final = Path(__file__).with_name("throughput.toml")


@dataclass(frozen=True)
class Line:
    """One kind of work of a step; `rate` in samples per second, None if it was not measured."""

    step: str
    what: str
    samples: int
    rate: float | None

    @property
    def seconds(self) -> float | None:
        """Estimated duration, s; None without a measured rate."""
        return None if self.rate is None else self.samples / self.rate


def throughputs(model: str, device: str) -> Mapping[str, float]:
    """Return measured samples per second by key for a network and a device; empty if none were measured."""
    tables = tomllib.loads(FILE.read_text(encoding="utf-8"))
    kind = device.partition(":")[0]
    if kind == "cpu" and not computes_bf16(kind):
        kind = "cpu-float32"
    found: Mapping[str, float] = tables.get(model, {}).get(kind, {}).get("rates", {})
    return found


def budget_of(recipe: Recipe, steps: Sequence[Step], device: str) -> list[Line]:
    """Return the work of every step."""
    rates = throughputs(recipe.model.name, device)
    lines: list[Line] = []
    for step in steps:
        lines += [Line(step.name, what, count, rates.get(key)) for what, count, key in _work(recipe, step)]
    return lines


def _work(recipe: Recipe, step: Step) -> Work:
    if step.stage == "dagger":
        expert = (
            [("drives of the expert", recipe.dagger.expert_episodes, "drive")] if recipe.dagger.expert_episodes else []
        )
        return [*expert, ("drives of the policy", recipe.dagger.episodes, "policy-drive")]
    if step.stage == "evaluate":
        count = recipe.evaluate.episodes if recipe.evaluate is not None else 0
        return [("episodes", count, "policy-drive")]
    work = BUDGETS[step.stage](recipe)
    return _after_round(recipe, step.stage, work) if step.round else work


def _after_round(recipe: Recipe, stage: str, work: Sequence[tuple[str, int, str]]) -> Work:
    """Return the work of a stage that continues after a DAgger round: caching new drives and training for a share."""
    dagger = recipe.dagger
    drives = dagger.episodes + dagger.expert_episodes
    more = drives / recipe.collect.episodes if recipe.collect is not None else 1.0
    config = recipe.imitate if stage == "imitate" else recipe.sft
    share = (config.go_on_share or 1.0) if config is not None else 1.0
    # The length of an SFT epoch grows with the number of drives; imitation has a fixed number of samples.
    shares = {"kv": more, "encode": more, "sft": share * (more if dagger.newest_only else 1.0)}
    tours_share = recipe.sft.tours_again if recipe.sft is not None else 1.0
    tours = {"tour": 0.0, "encode": 0.0, "sft": share * tours_share}  # no new tours; a share is trained on again
    counts = (
        (what, round(count * (tours if what.startswith(OF_TOURS) else shares).get(key, share)), key)
        for what, count, key in work
    )
    return [line for line in counts if line[1] > 0]


def lines_of(recipe: Recipe, steps: Sequence[Step], budget: Sequence[Line], device: str) -> list[str]:
    """Format the estimate as lines of text."""
    lines = [f"{recipe.name}: network {recipe.model.name}, seed {recipe.seed}, {device}"]
    for step in steps:
        own = [line for line in budget if line.step == step.name]
        for line in own:
            took = "not measured" if line.seconds is None else duration(line.seconds)
            lines.append(f"  {step.name:<11}{line.samples:>9,} {line.what:<28} {took}")
        if not own:
            lines.append(f"  {step.name:<11}{'':>9} no estimate")
    known = sum(line.seconds for line in budget if line.seconds is not None)
    open_ends = sum(line.seconds is None for line in budget)
    lines.append(f"  total {duration(known)}{f' plus {open_ends} parts without a measured rate' if open_ends else ''}")
    return lines


def as_json(budget: Sequence[Line]) -> list[dict[str, Any]]:
    """Return the estimate as the value that `--json` writes."""
    return [
        {
            "step": line.step,
            "what": line.what,
            "samples": line.samples,
            "rate_per_s": line.rate,
            "seconds": line.seconds,
        }
        for line in budget
    ]
