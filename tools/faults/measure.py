"""One injection: drive, inject, listen, judge, restore."""

from __future__ import annotations

import random
import signal
import time
from dataclasses import dataclass, field

from sim_hil.realtime.host_stall import HostStall
from tools.faults.rig.processes import Rig
from tools.faults.rig.received import (
    ReceivedCommand,
    first_lasting,
    longest_age_ms,
    longest_gap_ms,
    moves,
    moving_at,
)
from tools.faults.rows import Judge, Row

PHASE_S = 0.1
"""Injections are spread over this time: one tick."""
HOLD_S = 0.4
"""A stop counts as lasting after this time with zero commands only."""
WATCH_S = 2.0
"""Duration of the watch for rows that must change nothing."""
FRESH_S = 1.0
"""Duration of the watch for rows that judge the age of commands."""
STAY_S = 0.5
"""Duration of the watch of a latched stop after the end of its fault."""
RESUME_S = 15.0
LIMIT_TOLERANCE = 1.02
_RECENT_NS = 1_000_000_000
_POLL_S = 0.02
_ZERO = (0.0, 0.0, 0.0)
_ANY = float("inf")


@dataclass
class Sample:
    """Result of one injection; `latency_ms` is None if the expected reaction did not come in time, or if `stood`."""

    latency_ms: float | None
    stall_ms: float
    """Part of that time in which the machine stalled, ms."""
    wrong: list[str] = field(default_factory=list)
    """Other failures."""
    hindered: list[str] = field(default_factory=list)
    """Reason why the robot did not drive before or after the fault; a busy machine can cause it, so it is repeated."""
    ended: bool = False
    """Whether a run that may end or go on has ended."""
    stood: bool = False
    """Whether the robot stood before the fault."""


def injection(rig: Rig, row: Row, rng: random.Random, host: HostStall) -> Sample:
    """Make one injection into a robot that moves. Raises StepError or FaultError if the rig does not work."""
    rig.robot_obeys_motion()  # the trace of an hour of other rows takes longer to read than a bound
    time.sleep(rng.uniform(0.0, PHASE_S))
    before_ns = time.monotonic_ns()
    new = rig.received.sources() - {one.source for one in rig.received.since(before_ns - _RECENT_NS)}
    commanders = rig.received.sources() - new
    effect_ns = row.inject(rig)
    if row.judged_by is Judge.UNCHANGED:
        sample = _unchanged(rig, effect_ns, host)
    elif row.judged_by is Judge.FRESH:
        sample = _fresh(rig, effect_ns, host)
    else:
        sample = _awaited(rig, row, effect_ns, commanders, host)
    # Only the robot's own reaction cannot precede the effect.
    if not moving_at(rig.robot_obeys_motion(), effect_ns if row.judged_by is Judge.ROBOT else before_ns):
        sample.stood, sample.latency_ms = True, None  # neither a late reaction nor one in time
        sample.hindered.append("the robot stood before the fault")
    _aftermath(rig, row, sample, commanders)
    return sample


def _awaited(rig: Rig, row: Row, effect_ns: int, commanders: frozenset[int], host: HostStall) -> Sample:
    """Wait for the lasting reaction, for at most twice the bound and a second more."""
    end_ns = effect_ns + round((2 * row.bound_ms + 1000 + 1000 * HOLD_S) * 1e6)
    first: int | None = None
    while time.monotonic_ns() < end_ns:
        first = _first(rig, row, effect_ns, commanders)
        if first is not None and time.monotonic_ns() - first > HOLD_S * 1e9:
            break
        time.sleep(_POLL_S)
    if first is None:
        return Sample(None, host.between_ns(effect_ns, end_ns) / 1e6)
    # A command on its way when the fault took effect may already be the expected one.
    sample = Sample(max(first - effect_ns, 0) / 1e6, host.between_ns(effect_ns, first) / 1e6)
    if row.judged_by is Judge.LIMIT and not (
        rig.drives_on(RESUME_S) and _first(rig, row, first, commanders) is not None
    ):
        sample.hindered.append("stopped, not limited")
    return sample


def _first(rig: Rig, row: Row, effect_ns: int, commanders: frozenset[int]) -> int | None:
    if row.judged_by is Judge.ROBOT:
        changes = [change for change in rig.robot_obeys_motion() if change[0] >= effect_ns]
        return changes[-1][0] if changes and not changes[-1][1] else None
    received = moves(one for one in rig.received.since(effect_ns) if one.source in commanders)
    if row.judged_by is Judge.LIMIT:
        limits, scale = rig.config.limits, row.speed_scale * LIMIT_TOLERANCE
        return first_lasting(received, (limits.vx_max_mps * scale, _ANY, _ANY))
    return first_lasting(received, _ZERO)


def _unchanged(rig: Rig, effect_ns: int, host: HostStall) -> Sample:
    """Check that the commands continue and that none is zero or slower."""
    before_mps = rig.speed_mps()
    time.sleep(max(0.0, WATCH_S - (time.monotonic_ns() - effect_ns) / 1e9))
    end_ns = effect_ns + round(WATCH_S * 1e9)
    received: list[ReceivedCommand] = rig.received.since(effect_ns)
    moving = moves(one for one in received if one.moving)
    sample = Sample(longest_gap_ms(moving, effect_ns, end_ns), host.between_ns(effect_ns, end_ns) / 1e6)
    if any(not one.moving for one in received if one.velocity is not None):
        sample.hindered.append("a zero was sent")
    if min((velocity[0] for _, velocity in moving), default=0.0) < 0.8 * before_mps:
        sample.hindered.append("the speed fell")
    return sample


def _fresh(rig: Rig, effect_ns: int, host: HostStall) -> Sample:
    """Measure the longest age of the newest received command while the robot obeys it."""
    time.sleep(max(0.0, FRESH_S - (time.monotonic_ns() - effect_ns) / 1e9))
    end_ns = effect_ns + round(FRESH_S * 1e9)
    age_ms = longest_age_ms(rig.accepted_ns(), rig.robot_obeys_motion(), effect_ns, end_ns)
    return Sample(age_ms, host.between_ns(effect_ns, end_ns) / 1e6)


def _aftermath(rig: Rig, row: Row, sample: Sample, commanders: frozenset[int]) -> None:
    """End the fault and check the robot's behaviour afterwards."""
    if row.thaw:
        rig.send(rig.runner, signal.SIGCONT)
        _stays(rig, sample, commanders, "moved after SIGCONT")
    if row.undo is not None:
        row.undo(rig)
    if row.judged_by is Judge.FRESH:
        if not rig.drives_on(RESUME_S):
            sample.ended = True
            rig.kill_runner()
            rig.clear()
    elif row.starts_anew:
        rig.kill_runner()
        rig.clear()
    elif row.latches:
        if row.judged_by is not Judge.UNCHANGED and not row.thaw:
            _stays(rig, sample, commanders, "moved although the stop latches")
        rig.kill_runner()
        if row.kills_bridge:
            rig.kill_bridge()
        rig.clear()
        if row.operator_arms:
            rig.needs_operator = True  # of the next runner
    elif not rig.drives_on(RESUME_S):
        sample.hindered.append(f"did not drive on within {RESUME_S:g} s")
        rig.kill_runner()
        rig.clear()


def _stays(rig: Rig, sample: Sample, commanders: frozenset[int], otherwise: str) -> None:
    """Check that a latched stop remains when its fault has ended."""
    since_ns = time.monotonic_ns()
    time.sleep(STAY_S)
    if any(one.moving and one.source in commanders for one in rig.received.since(since_ns)):
        sample.wrong.append(otherwise)
