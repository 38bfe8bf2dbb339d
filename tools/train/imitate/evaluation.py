"""Errors of a policy's plans against the expert's on held-out drives, by the delay of the semantic state.

Baselines need no policy: keep the current velocity, or drive to the state's waypoints. The policy is also evaluated
with the semantic state of another drive; the difference is what the policy gains from the semantic state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge.motion.controller import TARGET_TIME_S, arc_to, target_of
from edge.state.reasoning_text import WAYPOINT_TIMES_S
from edge.state.semantic import waypoints_now
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import ImitateEvalConfig
from tools.train.drives.walls import OPEN_M, room
from tools.train.imitate.data import SampleChoice, Samples
from tools.train.samples.action_batch import ActionBatch, Group, collate

Array = NDArray[np.float64]
Planner = Callable[[ActionBatch], Tensor]
"""Maps a batch to trajectories [B, steps, 3]."""

HORIZONS_S: Final = (1, 2, 3, 5)
POLICY, KEEP, WAYPOINTS, OTHER_STATE = "policy", "keep_state", "waypoints", "other_words"
_TAG: Final = 0xADE


def keep_state(state: Array, steps: int) -> Array:
    """Return plans [n, steps, 3] that keep the body velocity `state` [n, 3] (vx m/s, vy m/s, wz rad/s)."""
    times = (np.arange(steps) + 1) / RATE_HZ
    turned = state[:, 2:] * times
    # sin(a)/a and (1 - cos(a))/a: the mean direction along the arc.
    ahead = np.sinc(turned / np.pi)
    aside = np.sin(turned / 2) * np.sinc(turned / 2 / np.pi)
    vx, vy = state[:, :1] * times, state[:, 1:2] * times
    return np.stack([ahead * vx - aside * vy, aside * vx + ahead * vy, turned], axis=-1)


def to_waypoints(points: Array, age_s: float, steps: int) -> Array:
    """Return a plan [steps, 3] along straight lines to waypoints [3, 2] m in the current frame, each at its time.

    `age_s`: time since the waypoints were predicted. Past waypoints are left out; after the last one the robot stands.
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
    """Sums of one predictor's errors in one delay bin."""

    count: int = 0
    speed: float = 0.0
    yaw_rate: float = 0.0
    mean_m: dict[int, list[float]] = field(default_factory=dict)
    last_m: dict[int, list[float]] = field(default_factory=dict)

    def add(self, planned: Array, target: Array, known: int) -> None:
        """Add a plan [steps, 3] and the expert's, of which the first `known` steps are real (at least 1 s)."""
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
        """Return the means in m, m/s and rad/s as JSON values."""
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
    """Return the controller's speed and yaw rate for a plan, before its limits."""
    return arc_to(target_of(plan.astype(np.float32), 1 / RATE_HZ), TARGET_TIME_S)


class _Scores:
    def __init__(self, edges_s: Sequence[float]) -> None:
        self._edges_s = tuple(edges_s)
        self._tallies: dict[tuple[str, int], _Tally] = {}

    def add(self, predictor: str, age_s: float, planned: Array, target: Array, known: int) -> None:
        """Add a plan to its bin and to the total (-1); a delay outside the bins counts for the total alone."""
        bins = [-1]
        if self._edges_s[0] <= age_s <= self._edges_s[-1]:
            bins.append(min(int(np.searchsorted(self._edges_s, age_s, side="right")), len(self._edges_s) - 1) - 1)
        for number in bins:
            self._tallies.setdefault((predictor, number), _Tally()).add(planned, target, known)

    def result(self) -> dict[str, Any]:
        """Return the errors over all delays and by bin."""
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
    semantics: bool = True,
) -> dict[str, Any]:
    """Return the errors of `planner` and the baselines. `semantics` False: the planner uses no semantic state."""
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
            if semantics and len(taken) > 1:
                plans[OTHER_STATE] = planner(_with_other_states(batch, len(taken)))
        arrays = {name: tensor.double().cpu().numpy() for name, tensor in plans.items()}
        _score(scores, samples, chosen, taken, arrays)
        for name, tensor in plans.items() if batch.around is not None else ():
            into_walls.setdefault(name, []).append(plans_into_walls(tensor, batch))
    shares = {name: float(np.concatenate(found).mean()) for name, found in into_walls.items() if sum(map(len, found))}
    return {"samples": groups * samples.group, **scores.result(), **({"into_walls": shares} if shares else {})}


def plans_into_walls(plans: Tensor, batch: ActionBatch) -> NDArray[np.bool_]:
    """Return, for the n frames with known walls, whether the plan touches a wall and the expert's does not: [n]."""
    assert batch.around is not None
    least = [
        room(each.float(), *batch.around).masked_fill(~batch.known, OPEN_M).amin(1) for each in (plans, batch.target)
    ]
    found: NDArray[np.bool_] = ((least[0] < 0) & (least[1] >= 0))[batch.around[1][:, 1] > 0].cpu().numpy()
    return found


def _with_other_states(batch: ActionBatch, groups: int) -> ActionBatch:
    """Give every group the semantic state of the previous group."""
    by = len(batch.guidance) // groups
    rolled = {name: torch.roll(getattr(batch, name), by, 0) for name in ("guidance", "real", "keep_guidance")}
    return ActionBatch(**{**vars(batch), **rolled})


def _score(
    scores: _Scores,
    samples: Samples,
    chosen: Sequence[SampleChoice],
    taken: Sequence[Group],
    plans: Mapping[str, Array],
) -> None:
    row = 0
    for one, group in zip(chosen, taken, strict=True):
        drive = samples.drives[one.drive]
        steps = group.target.shape[1]
        kept = keep_state(group.state.astype(np.float64), steps)
        points = samples.waypoints_of(one)
        for i, (k, age) in enumerate(zip(one.ks, one.ages, strict=True)):
            target, known, age_s = group.target[i].astype(np.float64), int(group.known[i].sum()), age / RATE_HZ
            for name, arrays in plans.items():
                scores.add(name, age_s, arrays[row], target, known)
            scores.add(KEEP, age_s, kept[i], target, known)
            if points is not None:
                now = waypoints_now(points, drive.offset(one.anchor, k))[0].astype(np.float64)
                straight = to_waypoints(now, (k - one.anchor) / RATE_HZ, steps)
                scores.add(WAYPOINTS, age_s, straight, target, known)
            row += 1
