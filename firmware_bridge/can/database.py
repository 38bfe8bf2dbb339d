"""A robot file's [can] tables together with its DBC file: every message and signal in use, checked once.

All errors are ConfigError with one line that names the place in the robot file, and message and signal of the DBC file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cantools
from cantools.database import Database as DbcFile
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal

from firmware_bridge.can.codec import UNITS, Signal
from firmware_bridge.can.protection import Crc, Protection
from firmware_bridge.can.traffic import planned_load
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.config_can import CanConfig, CanProtection
from firmware_bridge.core.dangers import TILT_RAD
from firmware_bridge.core.sections import ConfigError, require
from firmware_bridge.system.input_file import read_bytes

_KINDS: Final = {
    "can.command.vx": ("speed",),
    "can.command.wz": ("rotation",),
    "can.odometry.x": ("length",),
    "can.odometry.y": ("length",),
    "can.odometry.heading": ("angle",),
    "can.odometry.vx": ("speed",),
    "can.odometry.wz": ("rotation",),
    "can.wheels.left": ("rotation", "speed"),
    "can.wheels.right": ("rotation", "speed"),
    "can.imu.wz": ("rotation",),
    "can.imu.roll": ("angle",),
    "can.imu.pitch": ("angle",),
    "can.battery.charge": ("share",),
    "can.battery.voltage": ("voltage",),
    "can.battery.current": ("current",),
    "can.uptime": ("time",),
}
"""Kinds of quantity that a place may have; the others are integers without a unit."""
_LARGEST: Final = {"can.uptime": 2**62 / 1e9, "can.battery.charge": 1e6}
"""Largest values of what becomes an integer of 64 bits: the clock, s, which must not reach 2^63 ns; the charge, %."""
_MOST_STATE_BITS: Final = 32
_MOST: Final = 1e30
"""Bound of every other number of a signal: far above all units, and products of two are still finite."""
_OURS: Final = ("can.command.", "can.mode.", "can.estop.request")
_APART: Final = ("can.command.vx", "can.mode.request", "can.estop.request", "can.heartbeat")
_CYCLIC: Final = (
    *("can.odometry.", "can.wheels.", "can.state.", "can.imu.", "can.faults["),
    *("can.estop.button", "can.estop.latched"),
)
"""Places whose messages must have a cycle time: without one nobody would notice that they have ceased."""
_TILTS: Final = ("can.imu.roll", "can.imu.pitch")
_MOST_BYTES: Final = 8
_MOST_IDENTIFIER: Final = 0x7FF
_NS_PER_MS: Final = 1_000_000
_MAX_DBC_BYTES: Final = 4_000_000  # our choice: a hundred times a large base's file
_ENCODING: Final = "cp1252"  # of DBC files


@dataclass(frozen=True)
class Message:
    """One message in use; `cycle_ns` is 0 for an event."""

    name: str
    identifier: int
    length: int
    cycle_ns: int
    protection: Protection | None


@dataclass(frozen=True)
class CanDatabase:
    """Messages and signals in use.

    `received`: by identifier; `sent`: by name. `ours`: names of all our messages in the DBC, by identifier. `known`:
    all identifiers of the DBC. `signals`: by place in the robot file. `constants`: bits of a sent message's constants.
    `load`: share of the bus that all cyclic messages take.
    """

    received: dict[int, Message]
    sent: dict[str, Message]
    ours: dict[int, str]
    known: frozenset[int]
    signals: dict[str, Signal]
    constants: dict[str, int]
    load: float


def load_database(config: RobotConfig) -> CanDatabase:
    """Read the DBC file of a robot file and check both against each other. Raises ConfigError."""
    can = config.can
    if can is None:
        raise ConfigError("missing table [can]")
    return _Loader(config, can).load()


def _read(can: CanConfig) -> DbcFile:
    try:
        text = read_bytes(can.dbc_path, _MAX_DBC_BYTES).decode(_ENCODING, errors="replace")
        loaded = cantools.database.load_string(text, "dbc")
    except (OSError, ValueError, cantools.Error) as error:
        line = " ".join(str(error).split())
        raise ConfigError(f"can.dbc: {can.dbc_path}: expected a DBC file, found: {line}") from error
    require(isinstance(loaded, DbcFile), f"can.dbc: {can.dbc_path}: expected a DBC file of a CAN bus")
    assert isinstance(loaded, DbcFile)
    return loaded


class _Loader:
    def __init__(self, config: RobotConfig, can: CanConfig) -> None:
        self._config, self._can = config, can
        self._file = _read(can)
        self._messages = {message.name: message for message in self._file.messages}
        nodes = [node.name for node in self._file.nodes]
        known = ", ".join(nodes)
        require(can.node in nodes, f"can.node: expected a node of {can.dbc.name} ({known}), found {can.node!r}")

    def load(self) -> CanDatabase:
        can, signals = self._can, {}
        for where, text in can.signals().items():
            signals[where] = self._signal(where, text)
        used = {where: signal.message for where, signal in signals.items()}
        if can.heartbeat:
            used["can.heartbeat"] = can.heartbeat
        sent, received = {}, {}
        for where, name in used.items():
            message = self._message(where, name)
            if can.node in self._messages[name].senders:
                sent[name] = message
            else:
                received[message.identifier] = message
        self._check_directions(used)
        self._check_apart(used)
        self._check_command(signals, sent)
        self._check_values(signals)
        assigned = {where: signal for where, signal in signals.items() if signal.message in sent}
        constants = self._constants(sent, {str(signal) for signal in assigned.values()})
        ours = {m.frame_id: m.name for m in self._file.messages if can.node in m.senders}
        known = frozenset(message.frame_id for message in self._file.messages)
        return CanDatabase(received, sent, ours, known, signals, constants, self._load(sent))

    def _message(self, where: str, name: str) -> Message:
        dbc = self._messages.get(name)
        if dbc is None:
            raise ConfigError(f"{where}: expected a message of {self._can.dbc.name}, found {name!r}")
        standard = not (dbc.is_extended_frame or dbc.is_fd or dbc.is_multiplexed())
        fits = standard and 1 <= dbc.length <= _MOST_BYTES and dbc.frame_id <= _MOST_IDENTIFIER
        form = "a CAN 2.0A message of 1 to 8 bytes with 11 bits of identifier, not multiplexed"
        require(
            fits,
            f"{where}: {name}: expected {form}",
        )
        cycle_ns = round((dbc.cycle_time or 0) * _NS_PER_MS)
        cyclic = where == "can.heartbeat" or where.startswith(_CYCLIC)
        timed = cycle_ns > 0 or not cyclic
        require(timed, f"{where}: {name}: expected a GenMsgCycleTime in {self._can.dbc.name}, found none")
        return Message(name, dbc.frame_id, dbc.length, cycle_ns, self._protection(dbc))

    def _signal(self, where: str, text: str) -> Signal:
        name, _, signal_name = text.partition(".")
        message = self._messages.get(name)
        if message is None:
            raise ConfigError(f"{where}: expected a message of {self._can.dbc.name}, found {name!r}")
        found = [signal for signal in message.signals if signal.name == signal_name]
        if not found:
            names = ", ".join(signal.name for signal in message.signals)
            raise ConfigError(f"{where}: expected a signal of {name} ({names}), found {signal_name!r}")
        return self._converted(where, message, found[0])

    def _converted(self, where: str, message: DbcMessage, dbc: DbcSignal) -> Signal:
        text = f"{message.name}.{dbc.name}"
        integer = not dbc.is_float and not dbc.is_multiplexer
        require(integer, f"{where}: {text}: expected an integer signal, found a float or a multiplexer")
        kind, factor = self._unit(where, text, dbc)
        scale, offset = _number(dbc.scale) * factor, _number(dbc.offset) * factor
        if where not in _KINDS:
            require((scale, offset) == (1.0, 0.0), f"{where}: {text}: expected factor 1 and offset 0")
        require(scale != 0, f"{where}: {text}: expected a factor other than 0")
        least = -(1 << (dbc.length - 1)) if dbc.is_signed else 0
        ends = sorted((least * scale + offset, (least + (1 << dbc.length) - 1) * scale + offset))
        small = all(abs(value) < _MOST for value in (scale, offset, *ends))
        require(small, f"{where}: {text}: expected a factor, an offset and values below {_MOST:g}")
        bounds = (dbc.minimum, dbc.maximum)
        if None not in bounds and bounds != (0, 0):  # [0|0] in a DBC file means no range
            assert dbc.minimum is not None and dbc.maximum is not None
            ends = [max(ends[0], _number(dbc.minimum) * factor), min(ends[1], _number(dbc.maximum) * factor)]
        self._check_size(where, text, dbc, max(map(abs, ends)) + abs(scale) / 2, min(-ends[0], ends[1]))
        big = dbc.byte_order == "big_endian"
        return Signal(
            message.name,
            dbc.name,
            message.length,
            _shift(message.length, dbc),
            dbc.length,
            "big" if big else "little",
            dbc.is_signed,
            scale,
            offset,
            ends[0],
            ends[1],
            kind,
        )

    def _check_size(self, where: str, text: str, dbc: DbcSignal, largest: float, reach: float) -> None:
        """Refuse values that do not fit the datagram to the runner, and tilts that end below the bridge's own limit.

        `largest`: as far as decode() accepts; `reach`: how far the range goes to both sides of 0.
        """
        if where in _LARGEST:
            most = _LARGEST[where]
            require(largest <= most, f"{where}: {text}: expected a range of at most {most:g}, found {largest:g}")
        if where in _TILTS:
            need, found = math.degrees(TILT_RAD), math.degrees(reach)
            require(reach > TILT_RAD, f"{where}: {text}: expected a range of more than ±{need:g}°, found ±{found:g}°")
        fits = where != "can.state.signal" or dbc.length <= _MOST_STATE_BITS
        require(fits, f"{where}: {text}: expected at most {_MOST_STATE_BITS} bits, found {dbc.length}")

    def _unit(self, where: str, text: str, dbc: DbcSignal) -> tuple[str, float]:
        """Return the kind of quantity and the factor from the DBC's unit to ours."""
        if where not in _KINDS:
            return "", 1.0
        units = {unit: (kind, factor) for kind in _KINDS[where] for unit, factor in UNITS[kind].items()}
        expected = ", ".join(units)
        require((dbc.unit or "") in units, f"{where}: {text}: expected a unit of {expected}, found {dbc.unit!r}")
        return units[dbc.unit or ""]

    def _check_directions(self, used: dict[str, str]) -> None:
        for where, name in used.items():
            senders = self._messages[name].senders
            ours = where.startswith(_OURS) or where == "can.heartbeat"
            if ours != (self._can.node in senders):
                expected = self._can.node if ours else "another node"
                found = ", ".join(senders) or "nobody"
                raise ConfigError(f"{where}: {name}: expected {expected} as its sender, found {found}")

    def _check_apart(self, used: dict[str, str]) -> None:
        """Refuse two requests in one message: each frame of one would send a value of the other, unrequested."""
        places: dict[str, str] = {}
        for where in _APART:
            if where in used:
                other = places.setdefault(used[where], where)
                require(other == where, f"{where}: expected a message other than that of {other} ({used[where]})")

    def _check_command(self, signals: dict[str, Signal], sent: dict[str, Message]) -> None:
        vx, wz, limits = signals["can.command.vx"], signals["can.command.wz"], self._config.limits
        require(vx.message == wz.message, f"can.command: expected vx and wz in one message, found {vx} and {wz}")
        for signal, low, high in (
            (vx, limits.vx_min_mps, limits.vx_max_mps),
            (wz, -limits.wz_max_radps, limits.wz_max_radps),
        ):
            fits = signal.low <= low and high <= signal.high
            found = f"{signal.low:g}..{signal.high:g}"
            need = f"{low:g}..{high:g}"
            require(fits, f"can.command: {signal}: expected a range of at least {need} (limits), found {found}")
            rest = abs(signal.offset + round(-signal.offset / signal.scale) * signal.scale)
            stands = rest <= 1e-6 * abs(signal.scale)  # what floating-point numbers leave
            require(stands, f"can.command: {signal}: expected a raw value for exactly 0, found none: it could not stop")
        rate_hz, cycle_ns = self._config.bridge.rate_hz, sent[vx.message].cycle_ns
        slow = cycle_ns > 0 and cycle_ns * rate_hz < 1_000_000_000
        need = f"{1_000_000_000 / cycle_ns:g} at least" if cycle_ns else ""
        require(not slow, f"bridge.rate_hz: expected {need} (cycle time of {vx.message}), found {rate_hz}")
        timeout_ms = self._can.command.base_timeout_ms
        patient = timeout_ms * rate_hz > 2 * 1000
        need = f"more than {2 * 1000 / rate_hz:g} (one lost command at {rate_hz} Hz must not stop the base)"
        require(patient, f"can.command.base_timeout_ms: expected {need}, found {timeout_ms}")

    def _check_values(self, signals: dict[str, Signal]) -> None:
        can, needed = self._can, []
        if can.mode is not None:
            needed += [("can.mode.request", can.mode.arm), ("can.mode.request", can.mode.disarm)]
        if can.state is not None:
            values = (can.state.idle, can.state.armed, *([can.state.estop] if can.state.estop >= 0 else []))
            needed += [("can.state.signal", value) for value in values]
        if can.estop is not None and can.estop.request:
            needed += [("can.estop.request", value) for value in (can.estop.none, can.estop.stop, can.estop.reset)]
        for where, value in needed:
            signal = signals[where]
            found = f"{signal.low:g}..{signal.high:g}"
            require(signal.low <= value <= signal.high, f"{where}: {signal}: expected values in {found}, found {value}")

    def _constants(self, sent: dict[str, Message], assigned: set[str]) -> dict[str, int]:
        """Return the constant bits of every sent message; every signal of it must have a value."""
        bits, given = dict.fromkeys(sent, 0), set()
        for text in self._can.constants:
            place, _, number = text.partition("=")
            name, _, signal_name = place.partition(".")
            require(name in sent, f"can.constants: expected a message that the bridge sends, found {name!r}")
            dbc = next((each for each in self._messages[name].signals if each.name == signal_name), None)
            if dbc is None:
                raise ConfigError(f"can.constants: expected a signal of {name}, found {signal_name!r}")
            scale, least = _number(dbc.scale), -(1 << (dbc.length - 1)) if dbc.is_signed else 0
            exact = (float(number) - _number(dbc.offset)) / scale if scale else math.inf
            fits = abs(exact) < 1 << 64 and least <= round(exact) < least + (1 << dbc.length)
            require(fits, f"can.constants: {place}: expected a value that fits {dbc.length} bits, found {number}")
            raw = round(exact)
            bits[name] |= _in_frame(raw, self._messages[name].length, dbc)
            given.add(place)
        protection = self._can.protection
        protected = () if protection is None else (protection.crc, protection.counter)
        for name in sent:
            for signal in self._messages[name].signals:
                place = f"{name}.{signal.name}"
                free = place not in assigned | given and signal.name not in protected
                require(not free, f"can.constants: {place}: expected a value, found none; add {place}=0 or its value")
        return bits

    def _protection(self, dbc: DbcMessage) -> Protection | None:
        table = self._can.protection
        if table is None or dbc.name in table.unprotected:
            return None
        found = {signal.name: signal for signal in dbc.signals if signal.name in (table.crc, table.counter)}
        for key, name in (("crc", table.crc), ("counter", table.counter)):
            where = f"can.protection.{key}"
            hint = "or list the message as unprotected"
            require(name in found, f"{where}: {dbc.name}: expected a signal {name!r}, found none; {hint}")
        return _protection(table, dbc.name, found[table.crc], found[table.counter])

    def _load(self, sent: dict[str, Message]) -> float:
        command, cyclic = self._can.command.vx.partition(".")[0], []
        for message in self._file.messages:
            cycle_s = (message.cycle_time or 0) / 1000
            if message.name == command:
                cycle_s = 1 / self._config.bridge.rate_hz
            if cycle_s:
                cyclic.append((message.length, cycle_s))
        load = planned_load(cyclic, self._can.bitrate_bps)
        allowed = f"{self._can.max_load:.0%} of {self._can.bitrate_bps} bit/s"
        fits = load <= self._can.max_load
        require(fits, f"can.max_load: expected cyclic messages of at most {allowed}, found {load:.0%}")
        return load


def _number(value: float) -> float:
    """Return a number of the DBC file; one that is too large for a float becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _shift(length: int, dbc: DbcSignal) -> int:
    """Return the position of the lowest bit in the message read as one integer of the signal's byte order."""
    if dbc.byte_order == "little_endian":
        return dbc.start
    byte, bit = divmod(dbc.start, 8)  # of the highest bit
    return 8 * (length - 1 - byte) + bit - dbc.length + 1


def _in_frame(raw: int, length: int, dbc: DbcSignal) -> int:
    """Return a raw value as bits of the message read as a little-endian integer."""
    placed = (raw & ((1 << dbc.length) - 1)) << _shift(length, dbc)
    if dbc.byte_order == "little_endian":
        return placed
    return int.from_bytes(placed.to_bytes(length, "big"), "little")


def _protection(table: CanProtection, message: str, crc: DbcSignal, counter: DbcSignal) -> Protection:
    big = crc.byte_order == "big_endian"
    aligned = crc.length in (8, 16) and crc.start % 8 == (7 if big else 0)
    require(aligned, f"can.protection.crc: {message}.{crc.name}: expected 8 or 16 bits of whole bytes, found others")
    first = crc.start // 8
    crc_bytes = tuple(range(first, first + crc.length // 8))
    low_bit = counter.start - counter.length + 1 if counter.byte_order == "big_endian" else counter.start
    inside = counter.length <= 8 and low_bit >= 0 and low_bit // 8 == (low_bit + counter.length - 1) // 8
    inside &= low_bit // 8 not in crc_bytes
    place = f"{message}.{counter.name}"
    require(inside, f"can.protection.counter: {place}: expected bits of one byte that is not the CRC's, found others")
    values = 1 << counter.length
    period = table.counter_period or values
    need = f"2 * max_ahead ({2 * table.max_ahead}) to {values}"
    fits = 2 * table.max_ahead <= period <= values
    require(fits, f"can.protection.counter_period: {place}: expected {need}, found {period}")
    limit = 1 << crc.length
    for key in ("polynomial", "initial", "final_xor"):
        value: int = getattr(table, key)
        place = f"{message}.{crc.name}"
        require(
            value < limit,
            f"can.protection.{key}: expected less than {limit:#x} ({place}), found {value:#x}",
        )
    return Protection(
        Crc(crc.length, table.polynomial, table.initial, table.final_xor, table.reflected),
        crc_bytes if big else crc_bytes[::-1],
        table.covers,
        low_bit // 8,
        low_bit % 8,
        values - 1,
        period,
        table.max_ahead,
    )
