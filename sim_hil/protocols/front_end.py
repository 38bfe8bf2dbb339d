"""What `edge-hil`'s loop and a protocol's robot half agree on; `sim_hil.protocols.registry` lists the protocols.

The loop (`loop.py`) knows nothing else of a protocol. The robot half commands the robot and reads its truth through
the simulation. It keeps all its timing (stale commands, heartbeats) in the robot's own clock, the `stamp_s` that
`publish` is given, so that it can be tested without waiting; only `received_ns` is the real monotonic clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.scene import Scene


class FrontEndError(ValueError):
    """A protocol cannot be spoken as asked; one line for the operator: what, expected, found."""


@dataclass(frozen=True)
class FrontEndOptions:
    """What a front end may need to know of the command line.

    `scene_source` is what `load_scene` takes (a name or a file) and `scene` what it made of that, with the start that
    was asked for. `camera_size` is None for a robot without a camera. `link` is the protocol's address, in a form of
    its own; `domain` and `interface` are DDS's.
    """

    robot: str
    scene_source: str
    scene: Scene
    people: int
    seed: int
    camera_size: tuple[int, int] | None
    odometry_noise: str
    faults: Path | None
    link: str | None
    domain: int
    interface: str


@dataclass(frozen=True)
class ReceivedCommand:
    """One command as it was received, for the trace; `received_ns` is time.monotonic_ns.

    `service`: the part of the protocol that it was sent to. `api_id`: its number there. `name`: its name in the
    protocol's specification. `parameter`: its content as text. `request_id`: the sender's, 0 if the protocol has none.
    """

    received_ns: int
    service: str
    api_id: int
    name: str
    parameter: str
    request_id: int = 0


class FrontEnd(Protocol):
    """The robot's half of one protocol. Methods are called by one thread; only `wait` may wait, only `start` long."""

    def where(self) -> str:
        """Where it can be reached, in words, for the line that says that it is ready."""
        ...

    def start(self, render_state: NDArray[np.float64], stop: Sequence[int]) -> bool:
        """Wait until it can serve, the world being as in `render_state`; False when `stop` gets an element first.

        Raises RuntimeError or OSError when it cannot.
        """
        ...

    def wait(self, left_ns: int) -> None:
        """Sleep until something arrives, at most `left_ns`."""
        ...

    def serve(self) -> list[ReceivedCommand]:
        """Obey and answer what has arrived; returns it. Malformed input is counted and changes nothing."""
        ...

    def publish(self, step: int, stamp_s: float) -> None:
        """Called after physics step number `step`, at `stamp_s` of the robot's own clock: send what is due."""
        ...

    def show(self, render_state: NDArray[np.float64]) -> None:
        """The world as its cameras see it from now on; after every batch of steps."""
        ...

    def close(self) -> None:
        """Let go of everything; may be called twice."""
        ...

    def summary(self) -> Mapping[str, object]:
        """Its part of the result, after `close` too.

        `wire`: {commands, last_move, last_command, last_command_zero, malformed}; `video_frames`: pictures sent;
        `states`: odometry reports sent.
        """
        ...
