"""The runner's and the doctor's view of a robot whose link only the bridge reads: its reports, as the bridge passes
them on. It cannot command anything.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from firmware_bridge.core.config import OBSERVER_SUFFIX, RobotConfig
from firmware_bridge.core.link import MAX_DATAGRAM_BYTES, LinkError, decode
from firmware_bridge.core.robot_state import BatteryState, RobotState, within
from firmware_bridge.peer import BridgeUnavailable, connect

_WAIT_MS: Final = 100  # how soon close() is noticed
_RECONNECT_S: Final = 0.2
_LARGEST: Final = 1e6  # far beyond a position in m or a speed in m/s: finds garbage, not bad driving


class StateReader:
    """Newest state and battery of one robot. The bridge may start later, end and start again: it reconnects quietly."""

    def __init__(self, config: RobotConfig, *, on_death: Callable[[str], None] = lambda why: None) -> None:
        """`on_death` gets the reason once, in the reading thread, when that ends although nobody closed the reader."""
        self.malformed = 0
        """Datagrams that were no report of a robot, and states with an impossible number."""
        self.malformed_battery = 0
        """The same of battery reports, by which nobody drives."""
        self.reordered = 0
        """States dropped because they were not newer than one already delivered."""
        self.link_error = ""
        """Why there is no connection to the bridge, in one line; empty while there is one."""
        self._path = Path(f"{config.bridge.socket}{OBSERVER_SUFFIX}")
        self._on_death = on_death
        self._state: RobotState | None = None
        self._battery: BatteryState | None = None
        self._listener: Callable[[RobotState], None] | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="robot-state", daemon=True)
        self._thread.start()

    def state(self) -> RobotState | None:
        """The newest state, None before the first; any thread, never waits."""
        return self._state

    def battery(self) -> BatteryState | None:
        """The newest battery report, None before the first; judge its age by `received_ns`. Never waits."""
        return self._battery

    def surplus_publishers(self) -> str | None:
        """None: the bridge watches the robot's link for a second commander."""
        return None

    def set_state_listener(self, listener: Callable[[RobotState], None] | None) -> None:
        """Call `listener` with every state as it arrives, in the reading thread; it must not block or raise."""
        self._listener = listener

    def close(self) -> None:
        """Stop the reading thread and disconnect."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    with contextlib.closing(connect(self._path)) as connection:
                        self.link_error = ""
                        self._read(connection)
                except BridgeUnavailable as error:
                    self.link_error = str(error)
                self._closing.wait(_RECONNECT_S)
        except Exception as error:  # noqa: BLE001 - a dead thread must end the run, whatever killed it
            self._on_death(f"robot state thread died: {type(error).__name__}: {error}")

    def _read(self, connection: socket.socket) -> None:
        """Take datagrams until close(). Raises BridgeUnavailable when the bridge has closed the connection."""
        poller = select.poll()
        poller.register(connection, select.POLLIN)
        while not self._closing.is_set():
            if not poller.poll(_WAIT_MS):
                continue
            try:
                data = connection.recv(MAX_DATAGRAM_BYTES + 1)  # a longer datagram fails the length check
            except OSError as error:
                raise BridgeUnavailable(f"the connection to the bridge broke: {error.strerror}") from error
            if not data:
                raise BridgeUnavailable("the bridge has closed the connection")
            self._take(data)

    def _take(self, data: bytes) -> None:
        try:
            message = decode(data)
        except LinkError:
            self.malformed += 1
            return
        if isinstance(message, BatteryState):
            if within(_LARGEST, message.voltage_v, message.current_a):
                self._battery = message
            else:
                self.malformed_battery += 1
        elif not isinstance(message, RobotState) or not is_possible(message):
            self.malformed += 1
        elif self._state is not None and message.received_ns <= self._state.received_ns:
            self.reordered += 1
        else:
            self._state = message
            listener = self._listener
            if listener is not None:
                listener(message)


def is_possible(state: RobotState) -> bool:
    """Whether every number of a state is finite and of a plausible size, whatever the protocol."""
    speeds = (state.vx_mps, state.vy_mps, state.wz_radps, state.gyro_wz_radps or 0.0)
    return within(_LARGEST, *state.T_odom_base, state.position_z_m, *speeds, state.roll_rad, state.pitch_rad)
