"""Fuzzing of one backend in front of the bridge's rules, which no runner asks to arm."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from firmware_bridge.backends import robot_table
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import within
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Backend, Inputs, Move, Report, Stand

_MOST: Final = 1e8
"""Largest plausible number of a state, any unit: above it, or not finite, a decoder has let garbage through."""
_PROGRESS_S: Final = 10.0


class FuzzError(RuntimeError):
    """Motion, or a state that cannot be true; one line with the number of the input."""


class Target(Protocol):
    """A backend with its input. `decoded`: number of inputs that it has taken. `batch`: inputs of one step."""

    config: RobotConfig
    decoded: int
    batch: int

    @property
    def link(self) -> Backend:
        """Return the backend."""

    def now_ns(self) -> int:
        """Return the time of the next step."""

    def put(self, chance: random.Random) -> None:
        """Make one input and send it to the backend."""

    def motion(self) -> str | None:
        """Return in one line what the backend has sent since the last call that could move the robot; else None."""

    def close(self) -> None:
        """Close the backend."""


@dataclass(frozen=True)
class Result:
    """Counts of one run; `states` and `batteries`: inputs that became a report."""

    decoder: str
    inputs: int
    steps: int
    seconds: float
    malformed: int
    reordered: int
    states: int
    batteries: int


def fuzz(decoder: str, target: Target, inputs: int, seed: int, progress: Callable[[str], None]) -> Result:
    """Feed `inputs` inputs. Raises FuzzError for motion; an exception of the backend passes, after a line about it."""
    chance, config = random.Random(seed), target.config
    core = BridgeCore(config.bridge, config.limits, config.safety, robot_table(config), target.now_ns())
    begin_s = shown_s = time.monotonic()
    steps = states = batteries = 0
    try:
        while target.decoded < inputs:
            for _ in range(target.batch):
                target.put(chance)
            now_ns = target.now_ns()
            report = target.link.read(now_ns)
            _check_report(report)
            states, batteries, steps = states + (report.state is not None), batteries + bool(report.battery), steps + 1
            for request in core.step(Inputs(robot=report), now_ns).requests:
                if isinstance(request, Stand) or (isinstance(request, Move) and any(vars(request).values())):
                    raise FuzzError(f"the rules requested {request}")
                target.link.write(request)
            if (motion := target.motion()) is not None:
                raise FuzzError(f"the backend sent {motion}")
            if time.monotonic() - shown_s > _PROGRESS_S:
                shown_s = time.monotonic()
                progress(f"{target.decoded} of {inputs} inputs, {shown_s - begin_s:.0f} s")
    except Exception:
        progress(f"failed within {target.batch} inputs after input {target.decoded - target.batch}, seed {seed}")
        raise
    malformed, reordered, _ = target.link.dropped()
    seconds = round(time.monotonic() - begin_s, 1)
    return Result(decoder, target.decoded, steps, seconds, malformed, reordered, states, batteries)


def _check_report(report: Report) -> None:
    state, battery = report.state, report.battery
    if state is not None:
        numbers = [*state.T_odom_base, *(value for value in vars(state).values() if isinstance(value, float))]
        if not within(_MOST, *numbers):
            raise FuzzError(f"the decoder let through {state}")
    if battery is not None and not (0 <= battery.soc_percent <= 100 and within(_MOST, battery.voltage_v)):
        raise FuzzError(f"the decoder let through {battery}")


def mutated(good: bytes, chance: random.Random) -> bytes:
    """Return `good` with some bits flipped or bytes replaced, sometimes cut or extended."""
    data = bytearray(good)
    for _ in range(chance.choice((0, 1, 1, 2, 4, 16))):
        if data:
            at = chance.randrange(len(data))
            data[at] = data[at] ^ 1 << chance.randrange(8) if chance.random() < 0.5 else chance.randrange(256)
    if data and chance.random() < 0.1:  # lengths, infinities and NaN of the usual encodings
        at = chance.randrange(len(data))
        data[at : at + 8] = chance.choice((b"\xff" * 8, b"\x00\x00\xf8\x7f", b"\x00\x00\x80\x7f", b"\xff\xff\xff\x7f"))
    cut = chance.random()
    if cut < 0.05:
        del data[chance.randrange(len(data) + 1) :]
    elif cut < 0.1:
        data += chance.randbytes(chance.randrange(1, 64))
    return bytes(data)


def to_stderr(line: str) -> None:
    """Write one line of progress."""
    sys.stderr.write(f"fuzz: {line}\n")
    sys.stderr.flush()
