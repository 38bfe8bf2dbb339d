"""How far a policy's plans are from the expert's in places it has not seen, by the age of what it was told.

Beside it stand plans that need no policy: to keep on moving as now, and to drive to the waypoints that were said at the
anchor. And the policy itself with the words of another drive: what it loses by that is what the words give it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from edge.core.geometry import SE2
from edge.motion.controller import TARGET_TIME_S, arc_to, target_of
from edge.state.reasoning_text import WAYPOINT_TIMES_S, Waypoints
from edge.state.semantic import waypoints_now
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import ImitateEvalConfig
from tools.train.imitate.data import Chosen, Samples
from tools.train.samples.action_batch import ActionBatch, Group, collate
from tools.train.scenes.walls import OPEN_M, room

Array = NDArray[np.float64]
Planner = Callable[[ActionBatch], Tensor]
"""Trajectories [B, steps, 3] of a batch."""

HORIZONS_S: Final = (1, 2, 3, 5)
POLICY, KEEP, WAYPOINTS, OTHER_WORDS = "policy", "keep_state", "waypoints", "other_words"
_COLOURS: Final[Mapping[str, str]] = {
    POLICY: "#1f6f8b", KEEP: "#5b6774", WAYPOINTS: "#2c8c4a", OTHER_WORDS: "#d1603d",
}  # fmt: skip
_TAG: Final = 0xADE


def keep_state(state: Array, steps: int) -> Array:
    """[n, steps, 3]: on with the body velocity `state` [n, 3] (vx m/s, vy m/s, wz rad/s) as it is."""
    times = (np.arange(steps) + 1) / RATE_HZ
    turned = state[:, 2:] * times
    # sin(a)/a and (1 - cos(a))/a: the mean direction on the arc so far.
    ahead = np.sinc(turned / np.pi)
    aside = np.sin(turned / 2) * np.sinc(turned / 2 / np.pi)
    vx, vy = state[:, :1] * times, state[:, 1:2] * times
    return np.stack([ahead * vx - aside * vy, aside * vx + ahead * vy, turned], axis=-1)


def to_waypoints(points: Array, age_s: float, steps: int) -> Array:
    """[steps, 3]: straight from here to waypoints [3, 2] m in the current frame, each at the time it was said for.

    `age_s`: since they were said. Waypoints whose time is over are left out, after the last one the robot stands.
    """
    later = np.array(WAYPOINT_TIMES_S) - age_s
    open_ = later > 1e-9
    times = np.concatenate([[0.0], later[open_]])
    xy = np.concatenate([np.zeros((1, 2)), points[open_]])
    at = np.arange(steps + 1) / RATE_HZ
    way = np.stack([np.interp(at, times, xy[:, axis]) for axis in range(2)], axis=1)
    plan = np.zeros((steps, 3))
    plan[:, :2] = way[1:]
    heading = 0.0
    for i, (dx, dy) in enumerate(np.diff(way, axis=0)):
        if np.hypot(dx, dy) > 1e-3:
            heading = float(np.arctan2(dy, dx))
        plan[i, 2] = heading
    plan[:, 2] = np.unwrap(plan[:, 2])
    return plan


@dataclass
class _Tally:
    """Sums of one predictor's errors within one bin."""

    count: int = 0
    speed: float = 0.0
    yaw_rate: float = 0.0
    mean_m: dict[int, list[float]] = field(default_factory=dict)
    last_m: dict[int, list[float]] = field(default_factory=dict)

    def add(self, planned: Array, target: Array, known: int) -> None:
        """One plan [steps, 3] and the expert's, of which `known` steps are real (1 s of them at least)."""
        errors = np.hypot(*(planned - target)[:, :2].T)
        for horizon in HORIZONS_S:
            upto = horizon * RATE_HZ
            if upto <= min(known, len(errors)):
                self.mean_m.setdefault(horizon, []).append(float(errors[:upto].mean()))
                self.last_m.setdefault(horizon, []).append(float(errors[upto - 1]))
        speed, yaw_rate = _command(planned)
        wanted_speed, wanted_yaw_rate = _command(target)
        self.speed += abs(speed - wanted_speed)
        self.yaw_rate += abs(yaw_rate - wanted_yaw_rate)
        self.count += 1

    def numbers(self) -> dict[str, Any]:
        """JSON values; means in m, m/s and rad/s."""
        if not self.count:
            return {"samples": 0}
        return {
            "samples": self.count,
            "ade_m": {f"{horizon}s": float(np.mean(values)) for horizon, values in sorted(self.mean_m.items())},
            "fde_m": {f"{horizon}s": float(np.mean(values)) for horizon, values in sorted(self.last_m.items())},
            "speed_mps": self.speed / self.count,
            "yaw_rate_radps": self.yaw_rate / self.count,
        }


def _command(plan: Array) -> tuple[float, float]:
    """Speed and yaw rate that the controller would drive a plan with, before its limits."""
    return arc_to(target_of(plan.astype(np.float32), 1 / RATE_HZ), TARGET_TIME_S)


class _Scores:
    def __init__(self, edges_s: Sequence[float]) -> None:
        self._edges_s = tuple(edges_s)
        self._tallies: dict[tuple[str, int], _Tally] = {}

    def add(self, predictor: str, age_s: float, planned: Array, target: Array, known: int) -> None:
        """One plan, into its bin and into the whole (-1); an age beyond the bins counts for the whole alone."""
        bins = [-1]
        if self._edges_s[0] <= age_s <= self._edges_s[-1]:
            bins.append(min(int(np.searchsorted(self._edges_s, age_s, side="right")), len(self._edges_s) - 1) - 1)
        for number in bins:
            self._tallies.setdefault((predictor, number), _Tally()).add(planned, target, known)

    def result(self) -> dict[str, Any]:
        """Numbers over all ages, and by bin."""
        predictors = sorted({predictor for predictor, _ in self._tallies})

        def numbers(bin_: int) -> dict[str, Any]:
            return {each: self._tallies.get((each, bin_), _Tally()).numbers() for each in predictors}

        bins = [{"from_s": a, "to_s": b, **numbers(i)} for i, (a, b) in enumerate(pairwise(self._edges_s))]
        return {"all": numbers(-1), "by_delay": bins}


def evaluate(
    planner: Planner,
    samples: Samples,
    config: ImitateEvalConfig,
    *,
    seed: int,
    device: torch.device,
    words: bool = True,
) -> dict[str, Any]:
    """Errors of `planner` and of what stands beside it; `words` False: it is told none, so others change nothing."""
    scores, into_walls = _Scores(config.edges_s), dict[str, list[NDArray[np.bool_]]]()
    groups = -(-config.samples // samples.group)
    each = max(2, config.batch // samples.group)
    for start in range(0, groups, each):
        rngs = [np.random.default_rng((seed, _TAG, number)) for number in range(start, min(start + each, groups))]
        chosen = [samples.choose(rng) for rng in rngs]
        taken = [samples.take(one, rng) for one, rng in zip(chosen, rngs, strict=True)]
        batch = collate(taken, device)
        with torch.no_grad():
            plans = {POLICY: planner(batch)}
            if words and len(taken) > 1:
                plans[OTHER_WORDS] = planner(_with_others_words(batch, len(taken)))
        arrays = {name: tensor.double().cpu().numpy() for name, tensor in plans.items()}
        _score(scores, samples, chosen, taken, arrays)
        for name, tensor in plans.items() if batch.around is not None else ():
            into_walls.setdefault(name, []).append(plans_into_walls(tensor, batch))
    shares = {name: float(np.concatenate(found).mean()) for name, found in into_walls.items() if sum(map(len, found))}
    return {"samples": groups * samples.group, **scores.result(), **({"into_walls": shares} if shares else {})}


def plans_into_walls(plans: Tensor, batch: ActionBatch) -> NDArray[np.bool_]:
    """[n]: of the frames whose walls are known, whether the plan touches something where the expert's own does not."""
    assert batch.around is not None
    least = [
        room(each.float(), *batch.around).masked_fill(~batch.known, OPEN_M).amin(1) for each in (plans, batch.target)
    ]
    found: NDArray[np.bool_] = ((least[0] < 0) & (least[1] >= 0))[batch.around[1][:, 1] > 0].cpu().numpy()
    return found


def _with_others_words(batch: ActionBatch, groups: int) -> ActionBatch:
    """Every group with the semantic state of the one before it."""
    by = len(batch.guidance) // groups
    rolled = {name: torch.roll(getattr(batch, name), by, 0) for name in ("guidance", "real", "keep_guidance")}
    return ActionBatch(**{**vars(batch), **rolled})


def _score(
    scores: _Scores, samples: Samples, chosen: Sequence[Chosen], taken: Sequence[Group], plans: Mapping[str, Array]
) -> None:
    row = 0
    for one, group in zip(chosen, taken, strict=True):
        drive = samples.drives[one.drive]
        steps = group.target.shape[1]
        kept = keep_state(group.state.astype(np.float64), steps)
        said = samples.said(one)
        for i, (k, age) in enumerate(zip(one.ks, one.ages, strict=True)):
            target, known, age_s = group.target[i].astype(np.float64), int(group.known[i].sum()), age / RATE_HZ
            for name, arrays in plans.items():
                scores.add(name, age_s, arrays[row], target, known)
            scores.add(KEEP, age_s, kept[i], target, known)
            if said is not None:
                straight = _straight(said, drive.offset(one.anchor, k), (k - one.anchor) / RATE_HZ, steps)
                scores.add(WAYPOINTS, age_s, straight, target, known)
            row += 1


def _straight(said: Waypoints, offset: SE2, since_s: float, steps: int) -> Array:
    return to_waypoints(waypoints_now(said, offset)[0].astype(np.float64), since_s, steps)


def draw_errors(result: Mapping[str, Any], path: Path) -> None:
    """A picture of the errors by age; the same numbers give the same picture. Raises OSError."""
    bins = result["by_delay"]
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    ages = [(each["from_s"] + each["to_s"]) / 2 for each in bins]
    for name in sorted(result["all"]):
        rows = [each[name] for each in bins]
        horizons = [horizon for row in rows if row["samples"] for horizon in row["fde_m"]]
        if not horizons:
            continue
        shown = "3s" if "3s" in horizons else max(horizons)
        for axis, values in (
            (left, [row.get("fde_m", {}).get(shown, np.nan) for row in rows]),
            (right, [row.get("yaw_rate_radps", np.nan) for row in rows]),
        ):
            axis.plot(ages, values, marker="o", markersize=3, label=name.replace("_", " "), color=_COLOURS[name])
        left.set_ylabel(f"error after {shown[:-1]} s, m")
    right.set_ylabel("error of the yaw rate, rad/s")
    for axis in (left, right):
        axis.set_xlabel("age of the semantic state, s")
        axis.set_ylim(bottom=0)
        axis.grid(color="#dfe4e9", linewidth=0.6)
    right.legend(loc="best", fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
