"""Receives new instructions from a ROS 2 topic of std_msgs/String, with the rules of the instruction socket.

Every node of the DDS domain may send them, so they are worth as little as any input: checked, bounded, never able to
arm, and a stop phrase stops the robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from edge.flightlog.records import Throttle
from edge.reasoning.prompt import InstructionError, check_instruction
from edge.run.instructions import MAX_BYTES
from edge.run.stop_phrase import is_stop_phrase
from firmware_bridge.dds.bus import DDS_ERRORS, take_each
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.ros2.messages.common import String_

DEPTH: Final = 256
"""Number of samples kept between two polls, 50 ms apart: no stop phrase is lost on a topic of up to 5000 a second."""
REFUSALS_HZ: Final = 1.0
"""Most lines about refused instructions: a node that floods the topic must not flood the terminal."""

REPEATED_NS: Final = 5_000_000_000
"""The same text within this time of the last one is a repetition."""


class Ros2Instructions:
    """Takes instructions from one topic; reliable, so that a stop phrase is not lost. Raises DdsError."""

    def __init__(
        self,
        bus: SharedBus,
        topic: str,
        check: Callable[[str], None],
        stop: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """`topic`: DDS name. `check` and `stop`: as of `InstructionSocket`. `say` takes lines for the operator."""
        self.stopped = False
        """Whether a stop phrase has been received."""
        self._topic, self._check, self._stop, self._say = topic, check, stop, say
        self._refusals = Throttle(REFUSALS_HZ)
        self._newest, self._newest_ns = "", 0
        self._reader = bus.open().reader(topic, String_, depth=DEPTH, reliable=True)

    def poll(self) -> str | None:
        """Return the newest valid instruction since the last poll; None without one or after a stop phrase.

        A text that a node goes on sending, as `ros2 topic pub` does once a second, counts once: given again it would
        end the generation under way, and send a robot that has arrived off again.
        """
        texts = self._take()
        if any(map(is_stop_phrase, texts)):
            self.stopped = True
            stands = "the robot stands" if self._stop() else "standstill is not confirmed"
            self._say(f"stop phrase on {self._topic}: {stands}")
        elif texts and self.stopped:
            self._refuse("a stop phrase has ended this run")
        elif texts:
            try:
                if not self._repeats(texts[-1]):
                    self._check(texts[-1])  # this one only: it counts the prompt's tokens
                    return texts[-1]
            except InstructionError as error:
                self._refuse(str(error))
        return None

    def close(self) -> None:
        """Do nothing: the bus's owner closes the reader."""

    def _take(self) -> list[str]:
        """Take all samples that wait; return their instructions in one line each, oldest first."""
        texts: list[str] = []
        try:
            for sample in take_each(self._reader, DEPTH, MAX_BYTES):
                try:
                    texts.append(_text(sample))
                except InstructionError as error:
                    self._refuse(str(error))
        except DDS_ERRORS as error:
            self._refuse(f"DDS: {error.msg}")
        return texts

    def _repeats(self, text: str) -> bool:
        before, before_ns = self._newest, self._newest_ns
        self._newest, self._newest_ns = text, time.monotonic_ns()
        return text == before and self._newest_ns - before_ns < REPEATED_NS

    def _refuse(self, why: str) -> None:
        if self._refusals.due(time.monotonic_ns()):
            self._say(f"instruction on {self._topic} refused: {why}")


def _text(sample: String_ | None) -> str:
    """Return the instruction in one line; raises InstructionError."""
    if sample is None:
        raise InstructionError(f"expected a std_msgs/String of at most {MAX_BYTES} bytes")
    return check_instruction(sample.data)
