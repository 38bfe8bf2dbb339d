"""Tests whether the governor keeps the power budget, on a modelled Orin NX with a fake clock, at five loads.

    python -m tools.bench.governor --json out/bench/governor.json

The device is the plan's: stages take turns on one accelerator, control first. Its generations draw a multiple of the
plan's power: `light` needs no shedding, `limit` would draw exactly the budget, `plan` is the plan as it is, `far` asks
for three times, `lag` is `far` with a meter that averages over a second, as NVML's may. Meter noise, lost readings,
texts of random length, heat and leakage are added. The judge is the device's true power, not the governor's figures.
Exit code 1: the 10 s average was above the budget + 2 % later than 30 s after the start, control missed a tick, or
reasoning was shed without need. All numbers are modelled.
"""

from __future__ import annotations

import dataclasses
import math
import random
import sys
import time
from dataclasses import dataclass
from typing import Any, Final

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.power.governor.governor import Governor, GovernorConfig, GovernorInputs, GovernorOutputs
from edge.power.governor.plan import PowerPlan, power_plan
from edge.reasoning.generation_cycle import UNLIMITED, ReasoningBudget
from export.model.config import PRESETS
from export.plan.plan import plan
from export.targets.file import load_target
from tools.bench import bad_input, command_parser

WINDOW_S, SETTLE_S, TOLERANCE, LENGTH_S = 10.0, 30.0, 0.02, 600.0
NOISE, LOST = 0.02, 0.01
"""Relative standard deviation of a reading, and share of lost readings. Assumptions."""
REST_C, C_PER_W = 51.6, 1.39
"""Line of steady temperature over power, from ARK's notes on the Orin NX (4.6 W 58 °C, 29.4 W 89 to 92 °C)."""
HEAT_S, LEAKAGE_PER_C = 60.0, 0.002
"""Thermal time constant, and growth of a stage's power with temperature. Assumptions."""
LOADS: Final = ("light", "limit", "plan", "far", "lag")
LAG_S: Final = 1.0


@dataclass(frozen=True)
class Stages:
    """Power and duration of the device's stages, from the plan."""

    idle_w: float
    rise_w: float
    period_s: float
    tick_s: float
    prefill_calls: int
    prefill_call_s: float
    token_s: float
    context_s: float


def orin() -> tuple[Stages, PowerPlan]:
    """Return stages and power plan of the paper-size model on the target `orin`."""
    target, config = load_target("orin", "1b"), PRESETS["1b"]
    made = plan(target, config).to_dict()
    stages = made["per_graph"]
    power = power_plan({"plan": made, "provenance": {"target": target.to_dict()}}, made["tokens"])
    assert power.model is not None
    device = Stages(
        idle_w=power.model.idle_w,
        rise_w=stages["prefill"]["energy_j"] / (stages["prefill"]["ms"] / 1e3),
        period_s=made["period_ms"] / 1e3,
        tick_s=made["tick_alone_ms"] / 1e3,
        prefill_calls=stages["prefill"]["calls"],
        prefill_call_s=stages["prefill"]["ms"] / 1e3 / stages["prefill"]["calls"],
        token_s=stages["decode"]["ms"] / 1e3 / stages["decode"]["calls"],
        context_s=stages["semantic_context"]["ms"] / 1e3,
    )
    return device, power


def load_factor(load: str, stages: Stages, budget_w: float) -> float:
    """Return the ratio of power of a load's generations to the plan's."""
    control_w = stages.rise_w * stages.tick_s / stages.period_s
    rest_w = stages.rise_w * (1 - stages.tick_s / stages.period_s)
    limit = (budget_w - stages.idle_w - control_w) / rest_w
    return {"light": 0.7 * limit, "limit": limit, "plan": 1.0, "far": 3.0, "lag": 3.0}[load]


class Reasoning:
    """Model of the reasoning loop: requests its budget before a generation and between calls."""

    def __init__(self, stages: Stages, max_tokens: int, rng: random.Random) -> None:
        self._stages, self._max_tokens, self._rng = stages, max_tokens, rng
        self._calls: list[float] = []
        self._finished_s: float | None = None
        self.began_s = 0.0
        self.busy_s = 0.0
        self.generations = 0
        self.tokens = 0

    @property
    def running(self) -> bool:
        """Whether a generation is in progress."""
        return bool(self._calls)

    def next_call(self, now_s: float, budget: ReasoningBudget) -> float | None:
        """Return the duration of the next call, s; None if there is none now."""
        if self._calls and not budget.allowed:
            self._calls.clear()
            self.busy_s += now_s - self.began_s
        if self._calls:
            return self._calls[0]
        paused = self._finished_s is not None and now_s - self._finished_s < budget.pause_s
        if not budget.allowed or paused:
            return None
        wanted = self._rng.randint(self._max_tokens // 2, self._max_tokens)
        tokens = min(wanted, self._max_tokens if budget.max_new_tokens is None else budget.max_new_tokens)
        s = self._stages
        self._calls = [*[s.prefill_call_s] * s.prefill_calls, *[s.token_s] * tokens, s.context_s]
        self.began_s = now_s
        self.tokens += tokens
        return self._calls[0]

    def done(self, now_s: float) -> None:
        """Record the end of the current call."""
        self._calls.pop(0)
        if not self._calls:
            self._finished_s = now_s
            self.busy_s += now_s - self.began_s
            self.generations += 1

    def taken_s(self, now_s: float) -> float:
        """Return the total time of generations so far, s."""
        return self.busy_s + (now_s - self.began_s if self.running else 0.0)


@dataclass
class Run:
    """Record of a run by period."""

    true_w: list[float]
    average_w: list[float | None]
    pause_s: list[float]
    levels: list[str]
    ticks: int = 0
    missed: int = 0
    generations: int = 0
    tokens: int = 0
    step_us: float = 0.0


def simulate(load: str, *, seconds: float = LENGTH_S, seed: int = 0, governed: bool = True) -> Run:
    """Run the governor on the modelled device; without `governed` its budget is ignored."""
    stages, power = orin()
    budget_w = power.budget_w or math.nan
    factor = load_factor(load, stages, budget_w)
    config = GovernorConfig(budget_w, power.max_new_tokens, power.max_delay_s, power.model)
    governor, rng = Governor(config), random.Random(seed)
    reasoning = Reasoning(stages, power.max_new_tokens, rng)
    run = Run([], [], [], [])
    outputs = GovernorOutputs(UNLIMITED)
    temperature_c, free_s, spent_ns = REST_C + C_PER_W * stages.idle_w, 0.0, 0
    carried_j, shown_w = 0.0, stages.idle_w
    for index in range(round(seconds / stages.period_s)):
        start_s, end_s = index * stages.period_s, (index + 1) * stages.period_s
        hot = 1 + LEAKAGE_PER_C * (temperature_c - REST_C - C_PER_W * 25.0)
        # The energy of a call beyond the period's end belongs to the next period.
        energy_j, carried_j = carried_j, 0.0
        free_s = max(start_s, free_s) + stages.tick_s
        energy_j += stages.tick_s * stages.rise_w * hot
        run.ticks += 1
        run.missed += free_s > end_s + 1e-9
        while free_s < end_s:
            call_s = reasoning.next_call(free_s, outputs.budget if governed else UNLIMITED)
            if call_s is None:
                free_s = min(end_s, free_s + 0.02)
                continue
            inside_s = min(call_s, end_s - free_s)
            energy_j += inside_s * stages.rise_w * factor * hot
            carried_j = (call_s - inside_s) * stages.rise_w * factor * hot
            free_s += call_s
            reasoning.done(free_s)
        power_w = stages.idle_w + energy_j / stages.period_s
        temperature_c += (REST_C + C_PER_W * power_w - temperature_c) * stages.period_s / HEAT_S
        run.true_w.append(power_w)
        shown_w += (power_w - shown_w) * (1 - math.exp(-stages.period_s / LAG_S) if load == "lag" else 1.0)
        reading = None if rng.random() < LOST else max(0.0, shown_w * rng.gauss(1.0, NOISE))
        inputs = GovernorInputs(reading, reasoning.running, reasoning.taken_s(end_s), reasoning.generations)
        began_ns = time.perf_counter_ns()
        outputs = governor.step(inputs, round(end_s * 1e9))
        spent_ns += time.perf_counter_ns() - began_ns
        run.average_w.append(outputs.average_w)
        run.pause_s.append(outputs.budget.pause_s)
        run.levels.append(outputs.level)
    run.generations, run.tokens = reasoning.generations, reasoning.tokens
    run.step_us = spent_ns / 1e3 / max(run.ticks, 1)
    return run


def averages(true_w: list[float], period_s: float) -> list[float]:
    """Return the mean power of every whole window of 10 s; the first ends 10 s after the start."""
    width = round(WINDOW_S / period_s)
    total = sum(true_w[:width])
    found = [total / width]
    for old, new in zip(true_w, true_w[width:], strict=False):
        total += new - old
        found.append(total / width)
    return found


def judge(load: str, run: Run, budget_w: float, period_s: float = 0.1) -> dict[str, Any]:
    """Compute the figures of one run and check them."""
    windows = averages(run.true_w, period_s)
    over = [WINDOW_S + i * period_s for i, w in enumerate(windows) if w > budget_w * (1 + TOLERANCE)]
    settle_s = over[-1] if over else 0.0
    settled = windows[round((SETTLE_S - WINDOW_S) / period_s) :]
    worst = max(settled) / budget_w - 1
    minutes = len(run.true_w) * period_s / 60
    begin = round(SETTLE_S / period_s)
    shed = any(level != "full" for level in run.levels[begin:]) or any(pause > 0 for pause in run.pause_s[begin:])
    rate_hz = (run.ticks - run.missed) / (len(run.true_w) * period_s)
    ok = settle_s <= SETTLE_S and worst <= TOLERANCE and abs(rate_hz - 10.0) < 1e-6
    ok = ok and run.generations > 0 and (load != "light" or not shed)
    return {
        "budget_w": budget_w,
        "settle_s": round(settle_s, 2),
        "worst_over_percent": round(100 * worst, 3),
        "mean_w": round(sum(run.true_w) / len(run.true_w), 3),
        "control_hz": round(rate_hz, 4),
        "missed": run.missed,
        "generations_per_min": round(run.generations / minutes, 2),
        "tokens_per_generation": round(run.tokens / max(run.generations, 1), 1),
        "level_changes": sum(a != b for a, b in zip(run.levels, run.levels[1:], strict=False)),
        "last_level": run.levels[-1],
        "step_us": round(run.step_us, 1),
        "ok": ok,
    }


@command_line("governor")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__)
    p.add_argument("--seconds", type=float, default=LENGTH_S, help="modelled length of each run (default: 600)")
    p.add_argument("--seed", type=int, default=0, help="seed of noise and texts (default: 0)")
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        if not SETTLE_S < args.seconds <= 36_000:
            raise ValueError(f"--seconds {args.seconds:g}: expected more than {SETTLE_S:g} and at most 36000")
    except (OSError, ValueError) as error:
        return bad_input("governor", error)
    budget_w = orin()[1].budget_w or math.nan
    loads: dict[str, Any] = {}
    samples: dict[str, Any] = {}
    for load in LOADS:
        run = simulate(load, seconds=args.seconds, seed=args.seed)
        loads[load] = judge(load, run, budget_w)
        samples[load] = dataclasses.asdict(run)
    ok = all(row["ok"] for row in loads.values())
    write_result(args.json, {"loads": loads, "ok": ok, "seed": args.seed, "samples": samples, "tagged": "modelled"})
    if args.json != "-":
        for load, row in loads.items():
            print(
                f"{load:6} settles in {row['settle_s']:4.1f} s, worst 10 s {row['worst_over_percent']:+.2f} % of "
                f"{budget_w:g} W, mean {row['mean_w']:.2f} W, control {row['control_hz']:.2f} Hz, "
                f"{row['generations_per_min']:.1f} generations/min of {row['tokens_per_generation']:.0f} tokens, "
                f"level {row['last_level']}, {row['level_changes']} changes: {'ok' if row['ok'] else 'FAILED'}"
            )
    return EXIT_DONE if ok else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
