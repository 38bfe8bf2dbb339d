"""Interface between the loop of `edge-hil` and a front end; `sim_hil.protocols.registry` lists the protocols.

A front end is the robot's half of one protocol. It commands the robot and reads its ground truth through the
simulation. All its timing (stale commands, heartbeats) uses the robot's own clock, `stamp_s` of `publish`, so that
tests need not wait. Only `received_ns` uses the real monotonic clock.
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
    """A front end that cannot be opened as requested; one line: what, expected, found."""


@dataclass(frozen=True)
class FrontEndOptions:
    """Options of the command line for a front end.

    `scene_source`: name or file for `load_scene`; `scene`: the loaded scene with the requested start. `camera_size`:
    None for no camera. `link`: the protocol's address, in the protocol's own format. `domain`, `interface`: for DDS.
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
    view_fd: int | None = None
    """Descriptor for the camera's pictures of a live view; None: there is no view."""


@dataclass(frozen=True)
class ReceivedCommand:
    """One command received on the wire, for the trace; `received_ns` is time.monotonic_ns.

    `service`: addressed part of the protocol; `api_id`: the command's number there; `name`: its name in the protocol's
    documentation; `parameter`: its content as text; `request_id`: the sender's number, 0 if the protocol has none.
    `velocity`: requested (vx m/s, vy m/s, wz rad/s) in the base's axes, zero for a stop, None without a valid motion.
    `source`: number that the sender gives itself, 0 if the protocol has none.
    """

    received_ns: int
    service: str
    api_id: int
    name: str
    parameter: str
    request_id: int = 0
    velocity: tuple[float, float, float] | None = None
    source: int = 0


class FrontEnd(Protocol):
    """The robot's half of one protocol. One thread calls all methods; only `start` and `wait` may block."""

    def where(self) -> str:
        """Return the robot's address as text for the "ready" line."""
        ...

    def start(self, render_state: NDArray[np.float64], stop: Sequence[int]) -> bool:
        """Wait until the front end is ready, with the world in `render_state`; False if `stop` gets an element first.

        Raises RuntimeError or OSError if it cannot start.
        """
        ...

    def wait(self, left_ns: int) -> None:
        """Wait until data arrives, at most `left_ns` nanoseconds."""
        ...

    def serve(self) -> list[ReceivedCommand]:
        """Execute and answer the received commands and return them. Malformed input is counted and has no effect."""
        ...

    def publish(self, step: int, stamp_s: float) -> None:
        """Send the messages due after physics step number `step`, at `stamp_s` of the robot's own clock."""
        ...

    def injected(self) -> Sequence[str]:
        """Return the names of the faults that are switched on."""
        ...

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Set the world that the cameras render; called after every batch of steps."""
        ...

    def close(self) -> None:
        """Release all resources; may be called twice."""
        ...

    def summary(self) -> Mapping[str, object]:
        """Return the front end's part of the result; also works after `close`.

        `wire`: {commands, last_move, last_command, last_command_zero, malformed}; `video_frames`: images sent;
        `states`: odometry reports sent.
        """
        ...
