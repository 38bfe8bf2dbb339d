"""A wheeled base made from a robot file and its DBC file; encodes with cantools and computes CRCs bit by bit.

It shares no code with the bridge but the robot file's table, so that an error there does not cancel itself out.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import can
import cantools

from firmware_bridge.can.robot_link import RobotLink
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.config_can import CanConfig
from tests.support.processes import GO2_SIM

CARTER = GO2_SIM.with_name("carter_can_sim.toml")
EXAMPLE = GO2_SIM.with_name("example_can.toml")
MS = 1_000_000
_SI = {
    "m/s": 1.0, "mm/s": 1e-3, "rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30, "m": 1.0, "rad": 1.0,
    "s": 1.0, "%": 1.0, "V": 1.0, "mV": 1e-3, "A": 1.0, "mA": 1e-3,
}  # fmt: skip
_CHANNELS = itertools.count()


def crc_bit_by_bit(data: bytes, polynomial: int, initial: int, final_xor: int) -> int:
    """CRC of 8 bits, most significant bit first."""
    crc = initial
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ polynomial) & 0xFF if crc & 0x80 else crc << 1 & 0xFF
    return crc ^ final_xor


class DbcBase:
    """Base that drives as commanded while armed; `due` frames out, `receive` frames in.

    `left_out`: messages that it does not send. `wheels`: factors of the reported left and right wheel speed.
    `turns`: factor of the real yaw rate, 1 without slip. `obeys`: whether it follows commands. `places`: values in SI
    units by place in the robot file that replace its own.
    """

    def __init__(self, config: RobotConfig, now_ns: int) -> None:
        assert config.can is not None
        self.can: CanConfig = config.can
        self.file = cantools.database.load_file(self.can.dbc_path)
        self.by_id = {message.frame_id: message for message in self.file.messages}
        self._places = self.can.signals()
        self._next_ns = {
            message.name: now_ns
            for message in self.file.messages
            if self.can.node not in message.senders and message.cycle_time
        }
        self._counters: dict[str, int] = {}
        self._received_counters: dict[str, int] = {}
        self._start_ns = self._moved_ns = now_ns
        self._command_ns = self._mode_ns = -(10**12)
        self.pose, self.velocity = (0.0, 0.0, 0.0), (0.0, 0.0)
        self.state = 0 if self.can.state is None else self.can.state.idle
        self.left_out: set[str] = set()
        self.wheels, self.turns, self.obeys = (1.0, 1.0), 1.0, True
        self.places: dict[str, float] = {}
        self.commands: list[tuple[float, float]] = []
        self.requests = 0  # to change mode or emergency stop; one that a cyclic message repeats counts once
        self._request: int | None = None
        self.wrong: list[str] = []

    def receive(self, identifier: int, data: bytes, now_ns: int) -> None:
        """Check and obey one frame of the controller."""
        message = self.by_id[identifier]
        assert self.can.node in message.senders, message.name
        values = message.decode(data, decode_choices=False)
        if not self._is_right(message, data, values):
            self.wrong.append(message.name)
            return
        command, mode, estop = self.can.command, self.can.mode, self.can.estop
        if message.name == command.vx.partition(".")[0]:
            self._command_ns = now_ns
            self.commands.append((self._si(values, command.vx), self._si(values, command.wz)))
        elif mode is not None and message.name == mode.request.partition(".")[0]:
            self._mode_ns = now_ns
            request = int(values[mode.request.partition(".")[2]])
            self.requests += message.cycle_time is None or request != self._request
            self._request = request
            self._set_mode(request)
        elif estop is not None and estop.request and message.name == estop.request.partition(".")[0]:
            self.requests += 1
            self._estop(int(values[estop.request.partition(".")[2]]))

    def _set_mode(self, request: int) -> None:
        mode, state = self.can.mode, self.can.state
        assert mode is not None and state is not None
        if self.state in (state.idle, state.armed):
            self.state = state.armed if request == mode.arm else state.idle

    def _estop(self, request: int) -> None:
        estop, state = self.can.estop, self.can.state
        assert estop is not None and state is not None
        if request == estop.stop:
            self.state = state.estop
        elif request == estop.reset and self.state == state.estop:
            self.state = state.idle

    def _si(self, values: Mapping[str, float], place: str) -> float:
        name, _, signal = place.partition(".")
        unit = self.file.get_message_by_name(name).get_signal_by_name(signal).unit
        return float(values[signal]) * _SI[unit]

    def _is_right(self, message, data: bytes, values: Mapping[str, float]) -> bool:
        protection = self.can.protection
        if protection is None or message.name in protection.unprotected:
            return True
        counter, period = int(values[protection.counter]), protection.counter_period or 16
        last = self._received_counters.get(message.name)
        self._received_counters[message.name] = counter
        in_order = counter < period and (last is None or counter == (last + 1) % period)
        return in_order and values[protection.crc] == self._crc(message, data)

    def _crc(self, message, data: bytes) -> int:
        protection = self.can.protection
        assert protection is not None
        signal = message.get_signal_by_name(protection.crc)
        index = signal.start // 8
        parts = {
            "id_low": bytes((message.frame_id & 0xFF,)),
            "id_high": bytes((message.frame_id >> 8,)),
            "length": bytes((len(data),)),
            "data": data[:index] + data[index + 1 :],
        }
        covered = b"".join(parts[name] for name in protection.covers)
        return crc_bit_by_bit(covered, protection.polynomial, protection.initial, protection.final_xor)

    def due(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Move up to now, and return identifier and data of the frames to send."""
        self._move(now_ns)
        frames = []
        for name in self._next_ns:
            message = self.file.get_message_by_name(name)
            while self._next_ns[name] <= now_ns:
                self._next_ns[name] += message.cycle_time * MS
                if name not in self.left_out:
                    frames.append((message.frame_id, self.encode(name, now_ns)))
        return frames

    def _move(self, now_ns: int) -> None:
        can_table = self.can
        armed = can_table.state is None or self.state == can_table.state.armed
        mode = can_table.mode
        cycle_ms = self.file.get_message_by_name(mode.request.partition(".")[0]).cycle_time if mode else None
        if can_table.state and armed and cycle_ms and now_ns - self._mode_ns > 5 * cycle_ms * MS:
            self.state = can_table.state.idle
        fresh = now_ns - self._command_ns <= can_table.command.base_timeout_ms * MS
        if self.obeys:
            self.velocity = self.commands[-1] if armed and fresh and self.commands else (0.0, 0.0)
        passed_s, self._moved_ns = (now_ns - self._moved_ns) / 1e9, now_ns
        (x, y, theta), (vx, wz) = self.pose, self.velocity
        self.pose = (
            x + vx * math.cos(theta) * passed_s,
            y + vx * math.sin(theta) * passed_s,
            theta + wz * passed_s,
        )

    def _place_values(self, now_ns: int) -> dict[str, float]:
        (x, y, theta), (vx, wz), table = self.pose, self.velocity, self.can
        odometry = {"x": x, "y": y, "heading": math.remainder(theta, math.tau), "vx": vx, "wz": wz}
        found = {f"can.odometry.{name}": value for name, value in odometry.items()}
        if table.wheels is not None:
            for side, sign, factor in (("left", -1, self.wheels[0]), ("right", 1, self.wheels[1])):
                speed = (vx + sign * wz * table.wheels.track_m / 2) * factor
                found[f"can.wheels.{side}"] = speed / table.wheels.radius_m
        found |= {"can.imu.wz": wz * self.turns, "can.state.signal": self.state}
        found |= {"can.battery.charge": 80.0, "can.battery.voltage": 24.0, "can.battery.current": 2.0}
        found |= {"can.uptime": (now_ns - self._start_ns) / 1e9 + 100.0}
        if table.version is not None:
            found["can.version.signal"] = table.version.value
        if table.state is not None and self.state == table.state.estop:
            found["can.estop.latched"] = 1
        return found | self.places

    def encode(self, name: str, now_ns: int, **raw: float) -> bytes:
        """Return the next frame of a message; `raw`: physical values in the DBC's units that replace others."""
        message = self.file.get_message_by_name(name)
        given = {
            self._places[place]: value for place, value in self._place_values(now_ns).items() if place in self._places
        }
        values = {
            signal.name: given.get(f"{name}.{signal.name}", 0.0) / _SI.get(signal.unit, 1.0)
            for signal in message.signals
        } | raw
        protection = self.can.protection
        if protection is None or name in protection.unprotected:
            return bytes(message.encode(values, strict=False))
        counter = self._counters.get(name, 0)
        self._counters[name] = (counter + 1) % (protection.counter_period or 16)
        values |= {protection.crc: 0, protection.counter: counter}
        crc = self._crc(message, bytes(message.encode(values, strict=False)))
        return bytes(message.encode(values | {protection.crc: crc}, strict=False))


def virtual(path: Path, **changes: object) -> RobotConfig:
    """A robot file on a new virtual bus, with other values in [can]; its runner arms by itself."""
    config = load_robot_config(path)
    assert config.can is not None
    channel = f"tests-{next(_CHANNELS)}"
    settings = replace(config.can, interface="virtual", channel=channel, **changes)
    return replace(config, can=settings, safety=replace(config.safety, operator_arm=False))


class CanRig:
    """A link and a base on a virtual bus, on one clock that `spin` moves by 20 ms.

    `on_bus` changes the frames from the base: it takes a frame and returns those that arrive.
    """

    def __init__(self, path: Path = CARTER, config: RobotConfig | None = None) -> None:
        self.config = config or virtual(path)
        assert self.config.can is not None
        self._now_ns = time.monotonic_ns()
        self.bus = can.Bus(interface="virtual", channel=self.config.can.channel)
        self.lines: list[str] = []
        self.link = RobotLink(self.config, self.lines.append)
        self.base = DbcBase(self.config, self._now_ns)
        self.reporting = True
        self.on_bus: Callable[[int, bytes], list[tuple[int, bytes]]] = lambda identifier, data: [(identifier, data)]

    @property
    def commands(self) -> list[tuple[float, float]]:
        return self.base.commands

    @property
    def requests(self) -> int:
        return self.base.requests

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, identifier: int, data: bytes, *, error: bool = False) -> None:
        """Put a frame on the bus."""
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False, is_error_frame=error))

    def spin(self) -> None:
        """20 ms: the base receives, moves and reports twice."""
        for _ in range(2):
            while (message := self.bus.recv(0.0)) is not None:
                self.base.receive(message.arbitration_id, bytes(message.data), self._now_ns)
            self._now_ns += 10 * MS
            for identifier, data in self.base.due(self._now_ns):
                for arrived in self.on_bus(identifier, data) if self.reporting else ():
                    self.send(*arrived)

    def send_garbage(self) -> None:
        """Wrong CRC, wrong length and no data under every identifier of the DBC file that the base sends."""
        for name in self.base._next_ns:
            message = self.base.file.get_message_by_name(name)
            good = self.base.encode(name, self._now_ns)
            protected = self.base.can.protection and name not in self.base.can.protection.unprotected
            if protected:
                self.send(message.frame_id, bytes(255 - byte for byte in good))
            self.send(message.frame_id, good[:-1])
            self.send(message.frame_id, b"")

    def refuse(self) -> None:
        """From now on the controller takes no frame, as with a full queue."""

        def send(message: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("no buffer space available")

        assert self.link._bus is not None
        self.link._bus._bus.send = send  # type: ignore[method-assign]

    def close(self) -> None:
        self.link.close()
        self.bus.shutdown()
