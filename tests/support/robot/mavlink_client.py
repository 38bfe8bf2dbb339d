"""Minimal ground station, with which tests drive the rover."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Mapping
from typing import Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.udp import Address
from sim_hil.protocols.mavlink.vehicle import Mode, custom_mode_of
from sim_hil.protocols.mavlink.wire import Message, Reader, Writer

VELOCITY_AND_YAW_RATE: Final = 1 | 2 | 4 | 64 | 128 | 256 | 1024
HEARTBEAT_S: Final = 1.0
SETPOINT_S: Final = 0.05


class MavlinkClient:
    """Client of one rover: `poll` reads messages, `spin` waits while sending heartbeats and setpoints."""

    def __init__(
        self, robot: Address, *, system: int = 255, target: int = 1, key: bytes | None = None, now_ticks: int = 0
    ) -> None:
        """Open a socket; `system`: own MAVLink number; with `key`, all packets are signed."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._robot = robot
        self._target = target
        self._reader = Reader()
        self._writer = Writer(system, common.MAV_COMP_ID_MISSIONPLANNER, key, now_ticks)
        self.received: list[Message] = []
        self._latest: dict[str, Message] = {}

    @property
    def latest(self) -> Mapping[str, Message]:
        """Newest message of each type."""
        return self._latest

    @property
    def address(self) -> Address:
        """Own address."""
        host, port = self._socket.getsockname()
        return host, port

    def send(self, message: Message) -> None:
        """Send a message in one datagram."""
        self.send_bytes(self._writer.pack(message))

    def send_bytes(self, data: bytes) -> None:
        """Send a raw datagram."""
        with contextlib.suppress(ConnectionError):  # the robot's socket is closed
            self._socket.sendto(data, self._robot)

    def poll(self) -> list[Message]:
        """Read the received messages and return them."""
        new: list[Message] = []
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                new += self._reader.read(self._socket.recv(2048))
        for message in new:
            self._latest[message.get_type()] = message
        self.received += new
        return new

    def heartbeat(self) -> None:
        """Send a ground station's heartbeat."""
        self.send(
            common.MAVLink_heartbeat_message(
                common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, common.MAV_STATE_ACTIVE, 3
            )
        )

    def command(self, number: int, *params: float) -> None:
        """Send a COMMAND_LONG; missing parameters of the seven are 0."""
        values = (*params, *[0.0] * (7 - len(params)))
        self.send(common.MAVLink_command_long_message(self._target, 1, number, 0, *values))

    def arm(self, *, force: bool = False) -> None:
        """Request arming."""
        self.command(common.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196 if force else 0)

    def disarm(self) -> None:
        """Request disarming."""
        self.command(common.MAV_CMD_COMPONENT_ARM_DISARM, 0)

    def emergency_stop(self) -> None:
        """Request an emergency stop: a forced disarm."""
        self.command(common.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196)

    def set_mode(self, mode: Mode) -> None:
        """Request a mode."""
        main, sub = mode.value
        self.command(common.MAV_CMD_DO_SET_MODE, common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, main, sub)

    def drive(
        self,
        vx_mps: float,
        wz_radps: float,
        *,
        frame: int = common.MAV_FRAME_BODY_NED,
        mask: int = VELOCITY_AND_YAW_RATE,
        vy_mps: float = 0.0,
        yaw_rad: float = 0.0,
    ) -> None:
        """Send a setpoint; positive `wz_radps` turns left, `vy_mps` and `yaw_rad` follow MAVLink's convention."""
        self.send(
            common.MAVLink_set_position_target_local_ned_message(
                0, self._target, 1, frame, mask, 0, 0, 0, vx_mps, vy_mps, 0, 0, 0, 0, yaw_rad, -wz_radps
            )
        )

    @property
    def mode(self) -> Mode | None:
        """Mode in the rover's last heartbeat."""
        last = self._latest.get("HEARTBEAT")
        return None if last is None else custom_mode_of(last.custom_mode)

    @property
    def armed(self) -> bool:
        """Whether the rover's last heartbeat reports it as armed."""
        last = self._latest.get("HEARTBEAT")
        return last is not None and bool(last.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)

    def spin(self, seconds: float, vx_mps: float | None = None, wz_radps: float = 0.0) -> None:
        """Wait in real time while sending 1 heartbeat a second, and 20 setpoints a second unless `vx_mps` is None."""
        end = time.monotonic() + seconds
        next_heartbeat = next_setpoint = 0.0
        while (now := time.monotonic()) < end:
            if now >= next_heartbeat:
                self.heartbeat()
                next_heartbeat = now + HEARTBEAT_S
            if vx_mps is not None and now >= next_setpoint:
                self.drive(vx_mps, wz_radps)
                next_setpoint = now + SETPOINT_S
            select.select([self._socket], [], [], min(0.02, end - now))
            self.poll()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
