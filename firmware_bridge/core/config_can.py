"""The table [can] of a robot file: which message and signal of a DBC file plays which part.

A signal is written "MESSAGE.SIGNAL". Identifiers, scaling, byte order, lengths, units and cycle times stand in the DBC
file only; `firmware_bridge/can/database.py` checks these tables against it when the bus is opened.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar, Final

from firmware_bridge.core.sections import Section, require, runtime_dir, within_range

INTERFACES: Final = ("socketcan", "serial", "udp_multicast", "virtual")
ROBOT_FILES: Final = Path(__file__).parents[1] / "robots"
"""Folder of the shipped robot files and DBC files."""
CRC_INPUTS: Final = ("id_low", "id_high", "length", "data")
"""Parts of a frame that a CRC may cover; `data` are all its bytes but those of the CRC."""
_NUMBER: Final = r"-?([0-9]{1,20}(\.[0-9]{0,20})?|\.[0-9]{1,20})"
"""Number in `can.constants`; 20 digits are those of 64 bits."""


class CanTable(Section):
    """A table inside [can]; its fields of SIGNALS are signals, empty where a base has none."""

    SIGNALS: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.SIGNALS:
            text: str = getattr(self, name)
            parts = text.split(".")
            valid = text == "" or (len(parts) == 2 and all(parts))
            require(valid, f'{self.table_name}.{name}: expected "MESSAGE.SIGNAL", found {text!r}')


@dataclass(frozen=True)
class CanCommand(CanTable):
    """Velocity command: both signals are in one message, which is sent at the bridge's rate.

    `base_timeout_ms`: time after which the base stops by itself without a new command, as its maker states or the user
    has measured. Nothing else stops the base when the bridge or the cable dies.
    """

    vx: str
    wz: str
    base_timeout_ms: int = within_range(20, 2000)

    table_name = "can.command"
    SIGNALS = ("vx", "wz")


@dataclass(frozen=True)
class CanMode(CanTable):
    """Request to arm or disarm, sent `frames` times at once, or at its message's cycle time if the DBC gives one."""

    request: str
    arm: int
    disarm: int
    frames: int = within_range(1, 10, 3)

    table_name = "can.mode"
    SIGNALS = ("request",)


@dataclass(frozen=True)
class CanState(CanTable):
    """The base's own report of its state, and the values of that signal."""

    signal: str
    idle: int
    armed: int
    estop: int = -1  # of a base whose state does not tell

    table_name = "can.state"
    SIGNALS = ("signal",)


@dataclass(frozen=True)
class CanEstop(CanTable):
    """Emergency stop of the base: `button` is held down, `latched` lasts until a reset; `request` asks for either."""

    button: str = ""
    latched: str = ""
    request: str = ""
    none: int = 0
    stop: int = 1
    reset: int = 2
    frames: int = within_range(1, 10, 3)

    table_name = "can.estop"
    SIGNALS = ("button", "latched", "request")


@dataclass(frozen=True)
class CanOdometry(CanTable):
    """Pose and velocity as the base reports them. `same_counter`: frames of one sample have the same counter."""

    x: str
    y: str
    heading: str
    vx: str
    wz: str
    same_counter: bool = False

    table_name = "can.odometry"
    SIGNALS = ("x", "y", "heading", "vx", "wz")


@dataclass(frozen=True)
class CanWheels(CanTable):
    """Speeds of the two driven wheels, forwards positive: rotation rates, or speeds over the floor."""

    left: str
    right: str
    radius_m: float = within_range(0.01, 1)
    track_m: float = within_range(0.05, 3)

    table_name = "can.wheels"
    SIGNALS = ("left", "right")


@dataclass(frozen=True)
class CanImu(CanTable):
    """Gyroscope and attitude of the base."""

    wz: str = ""
    roll: str = ""
    pitch: str = ""

    table_name = "can.imu"
    SIGNALS = ("wz", "roll", "pitch")


@dataclass(frozen=True)
class CanBattery(CanTable):
    """Charge, voltage and current of the battery."""

    charge: str
    voltage: str = ""
    current: str = ""

    table_name = "can.battery"
    SIGNALS = ("charge", "voltage", "current")


@dataclass(frozen=True)
class CanVersion(CanTable):
    """Version that the base must report before it is armed."""

    signal: str
    value: int

    table_name = "can.version"
    SIGNALS = ("signal",)


@dataclass(frozen=True)
class CanProtection(CanTable):
    """End-to-end protection: names of the CRC and counter signals, equal in every protected message, and the CRC.

    `counter_period`: number of counter values, 0 for all that fit the signal. `max_ahead`: largest step of the counter;
    a larger one belongs to an old frame. `bad_in_a_row`: number of invalid frames of one message that stops the robot.
    `unprotected`: messages without these signals.
    """

    crc: str
    counter: str
    polynomial: int
    initial: int
    final_xor: int
    covers: tuple[str, ...]
    reflected: bool = False
    counter_period: int = within_range(0, 256, 0)
    max_ahead: int = within_range(1, 128, 6)
    bad_in_a_row: int = within_range(1, 20, 5)
    unprotected: tuple[str, ...] = ()

    table_name = "can.protection"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("polynomial", "initial", "final_xor"):
            value: int = getattr(self, name)
            require(0 <= value <= 0xFFFF, f"can.protection.{name}: expected 0..0xffff, found {value}")
        known = "data" in self.covers and set(self.covers) <= set(CRC_INPUTS)
        found = list(self.covers)
        require(known, f'can.protection.covers: expected "data" and any of {", ".join(CRC_INPUTS)}, found {found}')


@dataclass(frozen=True)
class CanAgreement(CanTable):
    """Differences, between command, wheels and gyroscope, from which the wheels slip or a sensor is broken.

    A difference counts above the constant plus `share` of the expected value, for the given time without a break.
    """

    vx_mps: float = within_range(0.05, 1, 0.2)
    wz_radps: float = within_range(0.1, 2, 0.3)
    share: float = within_range(0, 1, 0.5)
    command_s: float = within_range(0.5, 10, 2.0)
    gyro_s: float = within_range(0.2, 10, 1.0)

    table_name = "can.agreement"


@dataclass(frozen=True)
class CanConfig(Section):
    """Bus of a wheeled base. `interface` and `channel` are python-can's; `dbc` describes the frames.

    A relative `dbc` is beside the robot file, else one of the shipped files; a relative serial `channel` is in the
    user's runtime directory. `node`: our name in the DBC file. `heartbeat`: message that we send at its cycle time.
    `uptime`: signal of the base's clock. `faults`: signals that stop the robot unless they are 0, as error 101 and up.
    `constants`: "MESSAGE.SIGNAL=NUMBER" of the other signals of our messages. `max_load`: share of `bitrate_bps` that
    the bus's cyclic messages may take. `missing_cycles`: cycle times after which a message counts as missing, at least
    200 ms.
    """

    interface: str
    channel: str
    dbc: Path
    node: str
    command: CanCommand
    protection: CanProtection | None = None
    state: CanState | None = None
    mode: CanMode | None = None
    estop: CanEstop | None = None
    odometry: CanOdometry | None = None
    wheels: CanWheels | None = None
    imu: CanImu | None = None
    battery: CanBattery | None = None
    version: CanVersion | None = None
    agreement: CanAgreement = CanAgreement()
    heartbeat: str = ""
    uptime: str = ""
    faults: tuple[str, ...] = ()
    constants: tuple[str, ...] = ()
    bitrate_bps: int = within_range(10_000, 1_000_000, 500_000)
    max_load: float = within_range(0.05, 0.9, 0.7)
    missing_cycles: int = within_range(2, 100, 10)

    def __post_init__(self) -> None:
        super().__post_init__()
        known = self.interface in INTERFACES
        require(known, f"can.interface: expected one of {', '.join(INTERFACES)}, found {self.interface!r}")
        require(
            self.odometry is not None or self.wheels is not None,
            "missing table [can.odometry] or [can.wheels]: the bridge must know how the robot moves",
        )
        told = self.mode is None or self.state is not None
        require(told, "missing table [can.state]: [can.mode] needs the state that shows the request's effect")
        resets = self.estop is not None and self.estop.latched != "" and self.estop.request != ""
        seen = self.state is not None and self.state.estop >= 0
        need = "can.estop with latched and request needs the state in which an arming sends the reset"
        require(seen or not resets, f"missing key can.state.estop: {need}")
        for text in (self.uptime, *self.faults, *(text.partition("=")[0] for text in self.constants)):
            parts = text.split(".")
            valid = text == "" or (len(parts) == 2 and all(parts))
            require(valid, f'can.uptime, faults, constants: expected "MESSAGE.SIGNAL", found {text!r}')
        for text in self.constants:
            number = text.partition("=")[2]
            valid = re.fullmatch(_NUMBER, number) is not None
            require(valid, f'can.constants: expected "MESSAGE.SIGNAL=NUMBER", found {text!r}')
        if self.interface == "serial" and not Path(self.channel).is_absolute():
            object.__setattr__(self, "channel", str(runtime_dir() / self.channel))

    def with_files_of(self, folder: Path) -> CanConfig:
        """Return this table with the DBC file of the robot file's folder, where it is there."""
        beside = folder / self.dbc
        try:
            found = beside.is_file()
        except OSError:  # a folder that cannot be read, a name that is too long
            found = False
        return replace(self, dbc=beside) if found else self

    @property
    def dbc_path(self) -> Path:
        """Path of the DBC file: that of the robot file's folder, else the shipped one."""
        return self.dbc if self.dbc.is_absolute() else ROBOT_FILES / self.dbc

    def signals(self) -> dict[str, str]:
        """Return all signals in use by their place in the robot file, such as `can.command.vx`."""
        found: dict[str, str] = {}
        for each in fields(self):
            table = getattr(self, each.name)
            if isinstance(table, CanTable):
                found |= {f"{table.table_name}.{name}": getattr(table, name) for name in table.SIGNALS}
        found |= {"can.uptime": self.uptime} | {f"can.faults[{i}]": text for i, text in enumerate(self.faults)}
        return {where: text for where, text in found.items() if text}
