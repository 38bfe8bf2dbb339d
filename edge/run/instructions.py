"""Receives new instructions while the robot drives: a local socket, one JSON object a datagram, without waiting.

A stop phrase is not an instruction: it stops the robot, and no instruction is accepted after it.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from edge.live.feed import LiveFeed
from edge.reasoning.prompt import InstructionError, check_instruction
from edge.robot.arming import RefusedError
from edge.run.stop_phrase import is_stop_phrase
from edge.safety.faults.table import FAULTS
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.dds.shared_bus import SharedBus

if TYPE_CHECKING:
    from edge.run.assembly import RunOptions  # loads the engines, which the installer must not need

MAX_BYTES: Final = 4096
"""Largest datagram, bytes: 400 characters of an instruction, each in its longest JSON escape."""
MAX_A_POLL: Final = 4
STOP_PHRASE: Final = f"{FAULTS['stop-phrase'].message} {FAULTS['stop-phrase'].advice}"
"""Fault that ends a run when an instruction channel brings a stop phrase."""


class InstructionSocket:
    """Takes `{"instruction": TEXT}` and answers `{"accepted": TEXT}` or `{"error": WHY}` to a sender with an address.

    The answer to a stop phrase is `{"stopped": TEXT, "confirmed": BOOL, "bridge": PATH}`.

    Only this process's user may write to the socket (mode 0600). Raises OSError when the path is in use or cannot be
    created.
    """

    def __init__(self, path: Path, check: Callable[[str], None], stop: Callable[[], bool], bridge: Path) -> None:
        """`check` raises InstructionError for a text that does not fit the model's context.

        `stop` stops the robot and returns whether its bridge, which listens at `bridge`, has confirmed it.
        """
        self.stopped = False
        """Whether a stop phrase has been received."""
        self._path = path
        self._check = check
        self._stop = stop
        self._bridge = bridge
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(path.lstat().st_mode) and not _answers(path):
                path.unlink()  # left by a runner that was killed
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        umask = os.umask(0o177)
        try:
            self._socket.bind(str(path))
        except OSError as error:
            self._socket.close()
            raise OSError(f"--instructions {path}: expected a free path for a socket ({error.strerror})") from error
        finally:
            os.umask(umask)
        self._socket.setblocking(False)

    def poll(self) -> str | None:
        """Return the newest valid instruction since the last poll; None without one or after a stop phrase."""
        newest: str | None = None
        for _ in range(MAX_A_POLL):
            try:
                data, sender = self._socket.recvfrom(MAX_BYTES + 1)
            except OSError:  # nothing there
                break
            try:
                text = parse(data)
                if is_stop_phrase(text):
                    self.stopped, newest = True, None
                    confirmed = self._stop()
                    self._answer(sender, {"stopped": text, "confirmed": confirmed, "bridge": str(self._bridge)})
                    continue
                if self.stopped:
                    raise InstructionError("a stop phrase has ended this run: `edge-bridge arm` and start a new one")
                self._check(text)
            except InstructionError as error:
                self._answer(sender, {"error": str(error)})
                continue
            newest = text
            self._answer(sender, {"accepted": text})
        return newest

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _answer(self, sender: str | None, answer: dict[str, str | bool]) -> None:
        if sender:  # an unbound sender has no address
            with contextlib.suppress(OSError):  # the sender has closed its socket or does not read
                self._socket.sendto(json.dumps(answer).encode(), sender)


class InstructionChannel(Protocol):
    """Where new instructions come from; no method waits but `poll` after a stop phrase."""

    @property
    def stopped(self) -> bool:
        """Whether a stop phrase has been received."""

    def poll(self) -> str | None:
        """Return the newest valid instruction since the last poll; None without one or after a stop phrase."""

    def close(self) -> None:
        """Stop listening."""


class InstructionChannels:
    """Several channels as one: a stop phrase on one of them ends all."""

    def __init__(self, *channels: InstructionChannel) -> None:
        self._channels = channels

    @property
    def stopped(self) -> bool:
        """Whether a stop phrase has been received."""
        return any(channel.stopped for channel in self._channels)

    def poll(self) -> str | None:
        """Poll every channel; return the newest instruction of the last one that has one, None after a stop phrase."""
        found = [channel.poll() for channel in self._channels]
        return None if self.stopped else next((text for text in reversed(found) if text is not None), None)

    def close(self) -> None:
        """Close every channel."""
        for channel in self._channels:
            channel.close()


def open_channels(
    options: RunOptions,
    robot: RobotConfig,
    bus: SharedBus | None,
    check: Callable[[str], None],
    stop: Callable[[], bool],
    say: Callable[[str], None],
    live: LiveFeed | None,
) -> InstructionChannels:
    """Open the socket of the options and the robot file's topic, beside a live view. Raises RefusedError, DdsError."""
    channels: list[InstructionChannel] = [] if live is None else [live]
    try:
        if options.instructions is not None:
            channels.append(InstructionSocket(options.instructions, check, stop, robot.bridge.socket))
        if robot.ros2 is not None and robot.ros2.instruction and bus is not None:
            from edge.run.ros2_instructions import Ros2Instructions  # needs the extra of its protocol

            channels.append(Ros2Instructions(bus, robot.ros2.topic(robot.ros2.instruction), check, stop, say))
    except OSError as error:
        raise RefusedError(str(error)) from error
    return InstructionChannels(*channels)


def check_first_instruction(text: str) -> str:
    """Return a run's first instruction in one line; raises InstructionError, also for a stop phrase."""
    line = check_instruction(text)
    if is_stop_phrase(line):
        raise InstructionError(f"instruction {line!r} is a stop phrase: expected an instruction to drive")
    return line


def parse(data: bytes) -> str:
    """Return a datagram's instruction in one line; raises InstructionError."""
    if len(data) > MAX_BYTES:
        raise InstructionError(f"expected at most {MAX_BYTES} bytes, found {len(data)}")
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or set(content) != {"instruction"} or not isinstance(content["instruction"], str):
        raise InstructionError(f'expected {{"instruction": "..."}}, found {data[:60]!r}')
    return check_instruction(content["instruction"])


def _answers(path: Path) -> bool:
    """Whether a process holds this socket open."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True
