"""Conditions of a benchmark run: policy, clock, mode, latency, drift, variant.

They are sent as JSON to workers and cluster nodes, and stored in the run's `config.json`. A resumed run must have the
same conditions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from edge.state.switches import Switches, SwitchOptions
from sim_hil.benchmark.conditions.latency import LatencyError, LatencyProfile
from sim_hil.realtime.robots import GO2, ROBOTS
from sim_hil.robots.odometry_noise import LEVELS

BASELINES = ("expert", "point-goal", "random", "still")
PLACED = ("artifacts", "external", "point-goal-net")
"""Policy kinds that need a location: a directory, an address or a file."""
POLICIES = (*PLACED, *BASELINES)
CLOCKS = ("lockstep", "realtime")
MODES = ("async", "sync", "no-reasoning")
DRIFTS = tuple(LEVELS)
WORDINGS = ("benchmark", "training")
"""Sentence patterns of the instructions: the benchmark's own, which training never sees, or those of training."""
DEFAULT_LATENCY_S = {"async": 2.0, "sync": 2.0, "no-reasoning": 0.25}
"""Default latency of an artifact policy by mode, s: about 2 s (paper, appendix D); no reasoning: 4 Hz (section 4.4).
Results are released at ticks of 10 Hz, so 0.25 s becomes 0.3 s (3.3 Hz) in lockstep.
"""
MAX_EXTERNAL_TIMEOUT_S = 3600.0
_VARIANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", re.ASCII)
_CAMERA = re.compile(r"(\d{2,4})x(\d{2,4})", re.ASCII)


class ConditionsError(ValueError):
    """Unknown or contradictory conditions; one line: what, expected, found."""


@dataclass(frozen=True)
class PolicySpec:
    """A policy by kind and location: artifact directory, server address or file; empty for a baseline."""

    kind: str
    where: str = ""

    def __post_init__(self) -> None:
        needs_location = self.kind in PLACED
        if self.kind not in POLICIES or needs_location != bool(self.where):
            found = f"{self.kind}:{self.where}" if self.where else self.kind
            raise ConditionsError(
                f"policy {found!r}: expected artifacts:DIR, external:ADDR, point-goal-net:FILE, or one of "
                f"{', '.join(BASELINES)}"
            )

    @staticmethod
    def parse(text: str) -> PolicySpec:
        """Parse `expert`, `artifacts:DIR` and so on; paths become absolute. Raises ConditionsError."""
        kind, _, where = text.partition(":")
        spec = PolicySpec(kind, where)
        return PolicySpec(kind, str(Path(where).absolute())) if kind in ("artifacts", "point-goal-net") else spec

    def __str__(self) -> str:
        return f"{self.kind}:{self.where}" if self.where else self.kind


@dataclass(frozen=True)
class Conditions:
    """Conditions shared by all episodes of a run; `mode`, `latency` and `variant` are None if the policy has none."""

    policy: PolicySpec
    clock: str = "lockstep"
    mode: str | None = None
    latency: LatencyProfile | None = None
    drift: str = "none"
    variant: str | None = None
    wording: int = 0
    """Index of the episode's instruction that the robot receives, from 0."""
    wordings: str = "benchmark"
    swap_instructions: int | None = None
    """Seed of the permutation that gives every task the instruction of another task in its scene; None: its own."""
    turn_starts: int | None = None
    """Seed of the random headings with which the robots begin; None: along their routes, as the suite has it."""
    decoding: str | None = None
    """Decoding of an artifact policy's texts; None: the manifest's."""
    recovery: str | None = None
    """Whether recoveries may replace an artifact policy's commands; None: the manifest's."""
    speculation: str | None = None
    """Whether an artifact policy's calls verify guessed tokens, which changes no text; None: the manifest's."""
    stays: bool = False
    """Whether an artifact policy halts at the stop that its texts give; otherwise only the goal ends an episode."""
    camera: str = "auto"
    """Image rendered in every control period: `WxH` px, or `auto` for the policy's own input size (none if unused)."""
    external_timeout_s: float = 60.0
    """Maximum time for an external policy's answer, s."""
    robot: str | None = None
    """Robot of the stack that drives in real time (`sim_hil.realtime.robots`); None in lockstep, where each episode
    has its own."""

    def __post_init__(self) -> None:
        _one_of("clock", self.clock, CLOCKS)
        _one_of("drift", self.drift, DRIFTS)
        _one_of("wordings", self.wordings, WORDINGS)
        if (self.robot is not None) != (self.clock == "realtime"):
            raise ConditionsError(
                f"robot: expected one with clock realtime alone, found {self.robot} with {self.clock}"
            )
        if self.robot is not None:
            _one_of("robot", self.robot, tuple(ROBOTS))
        if self.swap_instructions is not None and not 0 <= self.swap_instructions < 2**31:
            raise ConditionsError(f"swapped instructions: expected a seed from 0, found {self.swap_instructions}")
        if self.turn_starts is not None and not 0 <= self.turn_starts < 2**31:
            raise ConditionsError(f"turned starts: expected a seed from 0, found {self.turn_starts}")
        if self.turn_starts is not None and self.swap_instructions is not None:
            raise ConditionsError("turned starts: expected without swapped instructions, found both; choose one")
        kind = self.policy.kind
        if self.mode is not None:
            _one_of("mode", self.mode, MODES)
        if (self.mode is not None) != (kind == "artifacts"):
            raise ConditionsError(
                f"mode: expected one for artifacts:DIR and for no other policy, found {self.mode} with {kind}"
            )
        for name, requested in (("stay", self.stays), *self._switches_by_name):
            if requested and kind != "artifacts":
                raise ConditionsError(f"{name}: expected only with artifacts:DIR, found with {kind}")
        try:
            _ = self.switches
        except ValueError as error:
            raise ConditionsError(str(error)) from error
        if self.latency is not None and kind in (*BASELINES, "point-goal-net"):
            raise ConditionsError(f"latency: expected only with artifacts:DIR or external:ADDR, found with {kind}")
        if kind == "artifacts" and self.clock == "lockstep" and self.latency is None:
            raise ConditionsError("latency: expected one for artifacts:DIR in lockstep, found none")
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
        """Decoding rules and recoveries requested of a policy from artifacts."""
        return SwitchOptions.parse(self.decoding, self.recovery, self.stays, self.speculation)

    @property
    def _switches_by_name(self) -> tuple[tuple[str, str | None], ...]:
        return ("decoding", self.decoding), ("recovery", self.recovery), ("speculation", self.speculation)

    def with_defaults_of(self, defaults: Switches) -> Conditions:
        """Return these conditions with a manifest's defaults where they leave a switch open. Raises ConditionsError."""
        return replace(
            self,
            decoding=self.decoding or defaults.decoding.value,
            recovery=self.recovery or defaults.recovery.value,
            speculation=self.speculation or defaults.speculation.value,
        )

    @property
    def camera_size(self) -> tuple[int, int] | None:
        """Requested image size (width, height), px; None: the policy's own input size."""
        if self.camera == "auto":
            return None
        match = _CAMERA.fullmatch(self.camera)
        size = (int(match[1]), int(match[2])) if match else (0, 0)
        if not (32 <= size[0] <= 1920 and 32 <= size[1] <= 1080):
            raise ConditionsError(f"camera {self.camera!r}: expected auto or WxH from 32x32 to 1920x1080")
        return size

    def as_json(self) -> dict[str, Any]:
        """Return the conditions as JSON values, to be read by `of_json`."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        latency = None if self.latency is None else self.latency.as_json()
        return {**values, "policy": str(self.policy), "latency": latency}

    @staticmethod
    def of_json(content: Mapping[str, Any]) -> Conditions:
        """Read conditions written by `as_json`; keys that an older version lacks get their defaults.

        Raises ConditionsError.
        """
        known = {each.name for each in fields(Conditions)}
        if not {"policy", "clock", "latency"} <= set(content) <= known:
            raise ConditionsError(f"conditions: expected the keys {sorted(known)}, found {sorted(content)}")
        try:
            latency = None if content["latency"] is None else LatencyProfile.of_json(content["latency"])
            before = {"robot": GO2.name} if content["clock"] == "realtime" else {}
            return Conditions(
                **{**before, **content, "policy": PolicySpec.parse(content["policy"]), "latency": latency}
            )
        except (TypeError, AttributeError, LatencyError) as error:
            raise ConditionsError(f"conditions: {error}") from error

    def describe(self) -> str:
        """Describe the conditions in one line for reports."""
        parts = [str(self.policy), self.clock]
        parts += [part for part in (self.robot, self.mode, self.variant) if part is not None]
        if self.latency is not None:
            parts.append(f"latency {self.latency.name}")
        if self.wordings != "benchmark":
            parts.append(f"{self.wordings} wordings")
        if self.swap_instructions is not None:
            parts.append(f"instructions swapped by {self.swap_instructions}")
        if self.turn_starts is not None:
            parts.append(f"starts turned by {self.turn_starts}")
        parts += [f"{name} {value}" for name, value in self._switches_by_name if value]
        if self.stays:
            parts.append("halts at its own stop")
        return ", ".join([*parts, f"drift {self.drift}"])


def _one_of(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConditionsError(f"{what} {value!r}: expected one of {', '.join(known)}")
