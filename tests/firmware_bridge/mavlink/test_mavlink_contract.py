"""The contract of every backend, for a PX4 rover behind a UDP socket."""

from __future__ import annotations

import contextlib
import random
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from firmware_bridge.mavlink.robot_link import RobotLink
from sim_hil.protocols.mavlink.wire import Message
from tests.support.robot.backend_contract import BackendContract
from tests.support.robot.rover_bench import BRIDGE, CARTER, RoverBench, robot_file


class RoverRig:
    """A link and a rover that moves as commanded."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        config = robot_file(link=f"udp:127.0.0.1:{self._socket.getsockname()[1]}")
        self.config = replace(config, bridge=replace(config.bridge, state_timeout_ms=300))
        self._rover = RoverBench(config)
        self.link = RobotLink(self.config, lambda _: None)
        self._bridge: tuple[str, int] | None = None
        self._packet = b""  # the newest one of the rover
        self._random = random.Random(0)
        self.reporting, self.requests = True, 0
        self.commands: list[tuple[float, float]] = []

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def spin(self) -> None:
        time.sleep(0.02)
        rover = self._rover
        rover.now_ns = time.monotonic_ns()
        with contextlib.suppress(BlockingIOError):
            while True:
                data, self._bridge = self._socket.recvfrom(2048)
                for message in rover.reader.read(data):
                    self._note(message)
                    rover.node.receive(message, BRIDGE, rover.now_s)
        rover.node.step(rover.now_s)
        messages = [*rover.node.answers(), *rover.node.due(rover.now_s)]
        if self._bridge is not None and self.reporting:
            for message in messages:
                self._packet = rover._writer.pack(message)
                self._socket.sendto(self._packet, self._bridge)

    def _note(self, message: Message) -> None:
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            self.commands.append((message.vx, -message.yaw_rate))
        elif message.get_type() == "COMMAND_LONG" and message.command in (176, 400):  # mode, arm
            self.requests += 1

    def send_garbage(self) -> None:
        assert self._bridge is not None
        wrong = self._packet[:-1] + bytes((self._packet[-1] ^ 0x55,))
        for data in (wrong, self._random.randbytes(40), b"\xfd", self._packet[:-3]):
            self._socket.sendto(data, self._bridge)

    def refuse(self) -> None:
        self.link._transport.send = lambda data: False  # type: ignore[method-assign]

    def close(self) -> None:
        self.link.close()
        self._socket.close()


class TestRoverContract(BackendContract):
    FILE = CARTER

    @pytest.fixture
    def rig(self) -> Iterator[RoverRig]:
        rig = RoverRig()
        yield rig
        rig.close()
