"""What a benchmark run was asked for, apart from its episodes: policy, clock, mode, latency, drift, variant.

It travels as JSON: to workers, to a cluster's nodes, and into the run's `config.json`, which a resumed run must match.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from edge.state.switches import Decoding, RecoverySwitch, SwitchOptions
from sim_hil.benchmark.conditions.latency import LatencyError, LatencyProfile
from sim_hil.robots.odometry_noise import LEVELS

BASELINES = ("expert", "point-goal", "random", "still")
PLACED = ("artifacts", "external", "point-goal-net")
"""Policies that are somewhere: a directory, an address, a file."""
POLICIES = (*PLACED, *BASELINES)
CLOCKS = ("lockstep", "realtime")
MODES = ("async", "sync", "no-reasoning")
DRIFTS = tuple(LEVELS)
WORDINGS = ("benchmark", "training")
"""Whose sentence patterns: the benchmark's own, which training never has, or training's, of the same ways."""
DEFAULT_LATENCY_S = {"async": 2.0, "sync": 2.0, "no-reasoning": 0.25}
"""Of a policy from artifacts: about 2 s (paper, appendix D), and without reasoning 4 Hz (section 4.4).

Releases are at ticks of 10 Hz, so that 0.25 s becomes 0.3 s in lockstep: 3.3 Hz.
"""
MAX_EXTERNAL_TIMEOUT_S = 3600.0
_VARIANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", re.ASCII)
_CAMERA = re.compile(r"(\d{2,4})x(\d{2,4})", re.ASCII)


class ConditionsError(ValueError):
    """Conditions that contradict each other or do not exist; one line: what, expected, found."""


@dataclass(frozen=True)
class PolicySpec:
    """Who drives: a kind, and where it is (artifact directory, address of a server; empty for a baseline)."""

    kind: str
    where: str = ""

    def __post_init__(self) -> None:
        wants_place = self.kind in PLACED
        if self.kind not in POLICIES or wants_place != bool(self.where):
            found = f"{self.kind}:{self.where}" if self.where else self.kind
            raise ConditionsError(
                f"policy {found!r}: expected artifacts:DIR, external:ADDR, point-goal-net:FILE, or one of "
                f"{', '.join(BASELINES)}"
            )

    @staticmethod
    def parse(text: str) -> PolicySpec:
        """`expert`, `artifacts:DIR` …; a directory becomes an absolute path. Raises ConditionsError."""
        kind, _, where = text.partition(":")
        spec = PolicySpec(kind, where)
        return PolicySpec(kind, str(Path(where).absolute())) if kind in ("artifacts", "point-goal-net") else spec

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}" if self.where else self.kind


@dataclass(frozen=True)
class Conditions:
    """Conditions of all episodes of a run; `mode`, `latency` and `variant` are None where the policy has none."""

    policy: PolicySpec
    clock: str = "lockstep"
    mode: str | None = None
    latency: LatencyProfile | None = None
    drift: str = "none"
    variant: str | None = None
    wording: int = 0
    """Which of an episode's instructions the robot is given."""
    wordings: str = "benchmark"
    swap_instructions: int | None = None
    """Seed by which every task is given the instruction of another one of its scene; None: its own."""
    decoding: str | None = None
    """Of a policy from artifacts: how its texts are decoded; None: as its manifest says."""
    recovery: str | None = None
    """Of a policy from artifacts: whether recoveries may replace its commands; None: as its manifest says."""
    stays: bool = False
    """Whether a policy from artifacts stands where its texts have placed the stop; an episode ends at the goal."""
    camera: str = "auto"
    """`WxH`: render such a picture in every control period; `auto`: what the policy looks at, if it does."""
    external_timeout_s: float = 60.0
    """How long an external policy may take for an answer."""

    def __post_init__(self) -> None:
        _one_of("clock", self.clock, CLOCKS)
        _one_of("drift", self.drift, DRIFTS)
        _one_of("wordings", self.wordings, WORDINGS)
        if self.swap_instructions is not None and not 0 <= self.swap_instructions < 2**31:
            raise ConditionsError(f"swapped instructions: expected a seed from 0, found {self.swap_instructions}")
        kind = self.policy.kind
        if self.mode is not None:
            _one_of("mode", self.mode, MODES)
        if (self.mode is not None) != (kind == "artifacts"):
            raise ConditionsError(f"mode: belongs to a policy from artifacts, found {self.mode} with {kind}")
        for name, asked in (("stay", self.stays), ("decoding", self.decoding), ("recovery", self.recovery)):
            if asked and kind != "artifacts":
                raise ConditionsError(f"{name}: belongs to a policy from artifacts, found it with {kind}")
        try:
            _ = self.switches
        except ValueError as error:
            raise ConditionsError(str(error)) from error
        if self.latency is not None and kind in (*BASELINES, "point-goal-net"):
            raise ConditionsError(f"latency: {kind} does not think; expected artifacts:DIR or external:ADDR with it")
        if kind == "artifacts" and self.clock == "lockstep" and self.latency is None:
            raise ConditionsError("latency: a policy from artifacts needs one in lockstep, found none")
        if self.variant is not None and (kind != "artifacts" or not _VARIANT.fullmatch(self.variant)):
            raise ConditionsError(
                f"variant {self.variant!r}: expected a name such as waypoints, with --policy artifacts:DIR"
            )
        if not 0 <= self.wording <= 100:
            raise ConditionsError(f"wording: expected 0 to 100, found {self.wording}")
        if not 0 < self.external_timeout_s <= MAX_EXTERNAL_TIMEOUT_S:
            raise ConditionsError(
                f"external timeout: expected up to {MAX_EXTERNAL_TIMEOUT_S:g} s, found {self.external_timeout_s}"
            )
        _ = self.camera_size

    @property
    def switches(self) -> SwitchOptions:
        """Decoding rules and recoveries that a policy from artifacts is asked for."""
        return SwitchOptions.parse(self.decoding, self.recovery, self.stays)

    def with_defaults_of(self, decoding: Decoding, recovery: RecoverySwitch) -> Conditions:
        """Return these conditions with a manifest's defaults where they leave a switch open. Raises ConditionsError."""
        return replace(
            self, decoding=self.decoding or decoding.value, recovery=self.recovery or recovery.value
        )  # fmt: skip

    @property
    def camera_size(self) -> tuple[int, int] | None:
        """(width, height) that was asked for; None: what the policy looks at."""
        if self.camera == "auto":
            return None
        match = _CAMERA.fullmatch(self.camera)
        size = (int(match[1]), int(match[2])) if match else (0, 0)
        if not (32 <= size[0] <= 1920 and 32 <= size[1] <= 1080):
            raise ConditionsError(f"camera {self.camera!r}: expected auto or WxH from 32x32 to 1920x1080")
        return size

    def as_json(self) -> dict[str, Any]:
        """What `of_json` reads."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        latency = None if self.latency is None else self.latency.as_json()
        return {**values, "policy": str(self.policy), "latency": latency}

    @staticmethod
    def of_json(content: Mapping[str, Any]) -> Conditions:
        """Conditions that `as_json` has written, also of a version that did not know all of them yet.

        Raises ConditionsError.
        """
        known = {each.name for each in fields(Conditions)}
        if not {"policy", "clock", "latency"} <= set(content) <= known:
            raise ConditionsError(f"conditions: expected the keys {sorted(known)}, found {sorted(content)}")
        try:
            latency = None if content["latency"] is None else LatencyProfile.of_json(content["latency"])
            return Conditions(**{**content, "policy": PolicySpec.parse(content["policy"]), "latency": latency})
        except (TypeError, AttributeError, LatencyError) as error:
            raise ConditionsError(f"conditions: {error}") from error

    def describe(self) -> str:
        """One line for people."""
        parts = [str(self.policy), self.clock]
        parts += [part for part in (self.mode, self.variant) if part is not None]
        if self.latency is not None:
            parts.append(f"latency {self.latency.name}")
        if self.wordings != "benchmark":
            parts.append(f"{self.wordings} wordings")
        if self.swap_instructions is not None:
            parts.append(f"instructions swapped by {self.swap_instructions}")
        parts += [
            f"{name} {value}" for name, value in (("decoding", self.decoding), ("recovery", self.recovery)) if value
        ]
        if self.stays:
            parts.append("stands where its texts have placed the stop")
        return ", ".join([*parts, f"drift {self.drift}"])


def _one_of(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConditionsError(f"{what} {value!r}: expected one of {', '.join(known)}")
