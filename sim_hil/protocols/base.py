"""Parts that front ends share: the interface of a wheeled base, the camera, and the summary of received commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_hil.protocols.fault_socket import FaultEndpoint
from sim_hil.protocols.render_process import RenderProcess

Vec3 = tuple[float, float, float]


class Base(Protocol):
    """Interface of a wheeled robot to its protocol."""

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Set the commanded velocity."""
        ...

    def stand(self) -> None:
        """Power the drive on."""
        ...

    def rest(self) -> None:
        """Brake, then power the drive off."""
        ...

    def press_estop(self) -> None:
        """Brake hard."""
        ...

    def release_estop(self) -> None:
        """Allow the drive to be powered again."""
        ...


class CommandLog:
    """Summary of the received commands in the base's axes (vx m/s, vy m/s, wz rad/s), for the result."""

    def __init__(self) -> None:
        self.commands = 0
        self.last_move: Vec3 | None = None
        self.last_command: str | None = None
        self.at_zero = True
        """Whether the last motion request was zero; true without any motion request."""

    def move(self, name: str, velocity: Vec3 | None) -> None:
        """Count a motion request; None: it contained no valid velocity."""
        self.last_command = name
        self.commands += 1
        self.last_move = velocity
        self.at_zero = velocity is not None and not any(velocity)

    def summary(self) -> dict[str, object]:
        """Return the `wire` part of the result, without `malformed`."""
        return {
            "commands": self.commands,
            "last_move": None if self.last_move is None else list(self.last_move),
            "last_command": self.last_command,
            "last_command_zero": self.at_zero,
        }


class CameraFrontEnd:
    """Front end whose camera, if it has one, renders in a process of its own."""

    _camera: RenderProcess | None = None
    _faults: FaultEndpoint | None = None

    def start(self, render_state: NDArray[np.float64], stop: Sequence[int]) -> bool:
        """Wait for the camera. Raises CameraProcessError."""
        self.show(render_state)
        return self._camera is None or self._camera.wait_ready(stop)

    def injected(self) -> Sequence[str]:
        """Return the names of the faults that are switched on."""
        return () if self._faults is None else self._faults.injected()

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Pass the state to render to the camera process."""
        if self._camera is not None:
            self._camera.show(render_state)
