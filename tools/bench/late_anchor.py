"""By how much late anchor shortens Δt, and what giving way to the tick costs and gains: all variants in one run.

    python -m tools.bench.late_anchor --artifacts out/demo/artifacts --json out/bench/late_anchor.json

A control thread ticks on random pictures as it would on the robot, while generations of four variants take turns: the
newest frame taken late or at once, giving way to the tick or not. Ticks with no generation beside them come first and
last. So whatever the machine does besides, it does to all of them. The JSON holds every sample.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.core.stats import percentiles
from edge.inference.generation_task import GenerationModels
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.scheduling import GiveWay, Schedule, TickActivity, enter, freeze_garbage, run_as, schedule_for
from edge.reasoning.generation_cycle import ReasoningConfig
from edge.run.reasoning_loop import ReasoningLoop, ReasoningSchedule
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from export.plan.measure import INSTRUCTION

CAMERA_LEAD = 0.5
"""Share of a period by which a frame is captured before its tick, as the runner asks for it."""
MARGIN_S = 3.0
ALONE = "alone"


class Ticks:
    """The control thread's part of a tick that computes: encode the newest frame, act on the newest semantic state."""

    def __init__(self, artifacts: Artifacts, schedule: Schedule, pictures: int = 8) -> None:
        runtime = artifacts.runtime
        self.activity = TickActivity(runtime.tick_period_ms * 1_000_000)
        self.policy = Policy(artifacts, schedule=schedule, activity=self.activity)
        self.slot = SemanticSlot()
        history_s = max(runtime.frame_offsets_s) + MARGIN_S
        self.ring = TokenRing(int(history_s * 1e3 / runtime.tick_period_ms) + 1, self.policy.tokens_shape)
        self.variant = ALONE
        self.samples_ms: dict[str, list[float]] = {}
        self.missed = 0
        self.said: list[str] = []
        self._schedule = schedule
        self._period_ns = runtime.tick_period_ms * 1_000_000
        rng, px = np.random.default_rng(0), runtime.image_px
        self._pictures = itertools.cycle(rng.integers(0, 256, (pictures, 1, px, px, 3)).astype(np.uint8))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="control")

    def __enter__(self) -> Ticks:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def running(self) -> bool:
        """Whether frames come by themselves."""
        return self._thread.is_alive()

    def encode(self, stamp_ns: int) -> EncodedFrame:
        """One frame captured at that instant, into the ring."""
        tokens = self.policy.encode(next(self._pictures), out=self.ring.next_buffer())
        frame = EncodedFrame(stamp_ns, SE2(stamp_ns / 1e9 % 100 * 0.5, 0.0, 0.0), tokens)
        self.ring.put(frame)
        return frame

    def fill(self) -> None:
        """The frames of a robot that has been on for longer than any frame is kept."""
        now_ns = time.monotonic_ns()
        for age in range(int((max(9.0, MARGIN_S) + 1) * 1e9 / self._period_ns), 0, -1):
            self.encode(now_ns - age * self._period_ns)

    def _run(self) -> None:
        self.said += enter(self._schedule.control)
        deadline_ns = time.monotonic_ns() + self._period_ns
        while not self._stop.wait(max(0, deadline_ns - time.monotonic_ns()) / 1e9):
            variant = self.variant
            frame = self.encode(deadline_ns - round(CAMERA_LEAD * self._period_ns))
            state = self.slot.state
            if state is not None:
                now_ns = time.monotonic_ns()
                offset = state.motion_offset(frame.T_odom_base)
                self.policy.act(frame.tokens, (0.5, 0.0, 0.0), state.delay_s(now_ns), offset, state)
                took_ms = (time.monotonic_ns() - deadline_ns) / 1e6
                # A tick during which the variant changed belongs to neither.
                if variant == self.variant:
                    self.samples_ms.setdefault(variant, []).append(took_ms)
            behind = (time.monotonic_ns() - deadline_ns) // self._period_ns
            self.missed += behind
            deadline_ns += self._period_ns * (behind + 1)


def run(artifacts: Artifacts, rounds: int, alone_s: float) -> dict[str, Any]:
    """Ticks alone, `rounds` generations of every variant in turn, ticks alone again."""
    schedule = schedule_for(artifacts)
    ticks, language = Ticks(artifacts, schedule), LanguageModel(artifacts, schedule=schedule)
    stop = threading.Event()

    def loop(late: bool, gives_way: bool) -> ReasoningLoop:
        return ReasoningLoop(
            GenerationModels(language, ticks.policy),
            SharedState(ticks.ring, ticks.slot),
            ReasoningConfig(artifacts.runtime.frame_offsets_s, artifacts.runtime.max_new_tokens),
            INSTRUCTION,
            stop=stop,
            schedule=ReasoningSchedule(give_way=GiveWay(ticks.activity) if gives_way else None, late_anchor=late),
        )

    loops = {
        f"{'late' if late else 'early'}{', gives way' if gives_way else ''}": loop(late, gives_way)
        for gives_way in (False, True)
        for late in (False, True)
    }
    ticks.fill()
    samples = run_as(schedule.reasoning, lambda: take_turns(ticks, loops, rounds, alone_s))
    return {
        "artifacts": str(artifacts.directory),
        "model": artifacts.model_name,
        "manifest_sha256": artifacts.manifest_sha256,
        "rounds": rounds,
        "shared": schedule.shared,
        "said": [*schedule.notes, *ticks.said],
        "missed_ticks": ticks.missed,
        "variants": {name: summary(values, ticks.samples_ms.get(name, [])) for name, values in samples.items()},
        "tick_alone_ms": percentiles(ticks.samples_ms.get(ALONE, []), "p50", "p99", "max"),
        "saved_ms_median": {way: saved(samples, way) for way in ("", ", gives way")},
        "samples": samples,
        "tick_samples_ms": ticks.samples_ms,
        "tagged": "measured",
    }


def take_turns(
    ticks: Ticks, loops: dict[str, ReasoningLoop], rounds: int, alone_s: float
) -> dict[str, dict[str, list[float]]]:
    """Every variant's samples by name (reasoning thread)."""
    for warmed in loops.values():  # what is allocated once
        generate(warmed, ticks, ALONE)
    samples: dict[str, dict[str, list[float]]] = {
        name: {"anchor_to_ready_ms": [], "generation_ms": [], "late_anchor_ms": []} for name in loops
    }
    with ticks:
        for name, one in loops.items():  # the first guesses of how long calls take
            generate(one, ticks, name)
        ticks.samples_ms.clear()
        rest(ticks, alone_s)
        for number in range(rounds):
            # Another order in every round: no variant always follows the same one.
            order = list(loops.items())
            for name, one in order[number % len(order) :] + order[: number % len(order)]:
                generate(one, ticks, name)
                for key, values in samples[name].items():
                    values.append(getattr(one.times, key).newest)
        rest(ticks, alone_s)
    return samples


def rest(ticks: Ticks, seconds: float) -> None:
    """Ticks with no generation beside them."""
    ticks.variant = ALONE
    time.sleep(seconds)


def generate(loop: ReasoningLoop, ticks: Ticks, variant: str) -> None:
    """One generation of a variant; raises ArtifactError when it fails."""
    ticks.variant = variant
    while not loop.step():
        if loop.cycle.failed:
            raise ArtifactError("a generation failed: check the artifacts with edge-export verify")
        if not ticks.running:
            ticks.encode(time.monotonic_ns())  # warm-up: nobody else does
        time.sleep(0.002)


def summary(values: dict[str, list[float]], tick_ms: list[float]) -> dict[str, Any]:
    """Percentiles of one variant."""
    result: dict[str, Any] = {key: percentiles(found, "p50", "p99", "max") for key, found in values.items()}
    return {**result, "tick_ms": percentiles(tick_ms, "p50", "p99", "max"), "ticks": len(tick_ms)}


def saved(samples: dict[str, dict[str, list[float]]], way: str) -> float:
    """Median over the rounds of how much later the early variant is."""
    early, late = (samples[f"{kind}{way}"]["anchor_to_ready_ms"] for kind in ("early", "late"))
    return round(statistics.median(a - b for a, b in zip(early, late, strict=True)), 2)


@command_line("late_anchor")
def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR")
    p.add_argument("--rounds", type=int, default=40, metavar="N", help="generations of every variant (default: 40)")
    p.add_argument("--alone", type=float, default=10.0, metavar="S", help="ticks alone, before and after (default: 10)")
    p.add_argument("--json", metavar="FILE|-", help="write every sample as JSON")
    args = p.parse_args(argv)
    try:
        if args.rounds < 1 or not 1 <= args.alone <= 600:
            raise ArtifactError("--rounds must be at least 1 and --alone 1 to 600 s")
        check_result_target(args.json)
        freeze_garbage()
        result = run(load_artifacts(args.artifacts), args.rounds, args.alone)
        write_result(args.json, result)
    except (ArtifactError, OSError) as error:
        sys.stderr.write(f"late_anchor: {error}\n")
        return EXIT_BAD_INPUT
    if args.json != "-":
        print(report(result))
    return EXIT_DONE


def report(result: dict[str, Any]) -> str:
    """The result as a small table."""
    lines = [f"{'variant':18}  anchor→ready ms p50 / p99   generation ms p50   tick ms p50 / p99"]
    for name, v in result["variants"].items():
        ready, tick = v["anchor_to_ready_ms"], v["tick_ms"]
        lines.append(
            f"{name:18}  {ready['p50']:8.1f} / {ready['p99']:8.1f}        {v['generation_ms']['p50']:8.1f}         "
            f"{tick['p50'] or 0:6.1f} / {tick['p99'] or 0:6.1f}"
        )
    alone = result["tick_alone_ms"]
    lines.append(f"{'ticks alone':18}  {'':48}  {alone['p50']:6.1f} / {alone['p99']:6.1f}")
    one, way = result["saved_ms_median"].values()
    lines.append(f"late anchor shortens Δt by {one:.1f} ms, giving way by {way:.1f} ms (medians of pairs)")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
