"""Instructions from a ROS 2 topic: the rules of the socket, and nothing that a node sends can raise."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.reasoning.prompt import InstructionError
from edge.run import ros2_instructions as module
from edge.run.instructions import InstructionChannels
from edge.run.ros2_instructions import Ros2Instructions
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds import bus as bus_module
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.ros2.messages.common import String_
from tests.support.processes import wait_for

TOPIC = "rt/instruction"


def refuse_long(text: str) -> None:
    if len(text.split()) > 20:
        raise InstructionError("too long for the model")


@dataclass
class Rig:
    """A channel, a node that sends to it, the lines for the operator and the number of stops."""

    bus: SharedBus
    lines: list[str] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    stops: int = 0

    def __post_init__(self) -> None:
        self.channel = Ros2Instructions(self.bus, TOPIC, self._check, self._stop, self.lines.append)
        self._writer = self.bus.open().writer(TOPIC, String_, depth=8)

    def _check(self, text: str) -> None:
        self.checked.append(text)
        refuse_long(text)

    def _stop(self) -> bool:
        self.stops += 1
        return True

    def send(self, *texts: str) -> None:
        for text in texts:
            self._writer.write(String_(text))

    def taken(self, done: Callable[[], object] = lambda: False) -> str | None:
        """The first instruction that a poll returns; None once `done()`."""
        found: list[str] = []

        def poll() -> bool:
            found.extend(text for text in [self.channel.poll()] if text is not None)
            return bool(found or done())

        wait_for(poll, 5, "an instruction")
        return found[0] if found else None


@pytest.fixture
def rig(dds_domain: int) -> Iterator[Rig]:
    bus = SharedBus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    yield Rig(bus)
    bus.close()


def test_an_instruction_arrives_in_one_line_and_once(rig: Rig) -> None:
    assert rig.channel.poll() is None
    rig.send("walk  to the\nvending machine")
    assert rig.taken() == "walk to the vending machine"
    assert rig.channel.poll() is None and rig.lines == []


def test_a_text_that_a_node_repeats_is_taken_once_until_it_has_paused(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_s = iter((0.0, 1.0, 2.0, 7.5))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic_ns=lambda: round((next(at_s) + 10) * 1e9)))
    monkeypatch.setattr(rig.channel, "_take", lambda: ["walk to the door"])
    assert [rig.channel.poll() for _ in range(4)] == ["walk to the door", None, None, "walk to the door"]


def test_a_text_that_another_one_has_replaced_is_taken_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = iter(("walk to the door", "turn left", "walk to the door"))
    monkeypatch.setattr(rig.channel, "_take", lambda: [next(texts)])
    assert [rig.channel.poll() for _ in range(3)] == ["walk to the door", "turn left", "walk to the door"]


def test_the_newest_of_several_is_taken(rig: Rig) -> None:
    rig.send("walk to the door", "turn left")
    assert rig.taken() == "turn left"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "instruction is empty"),
        ("a" * 401, "401 characters"),
        ("b" * 5000, "at most 4096 bytes"),
        ("word " * 21, "too long for the model"),
    ],
)
def test_a_text_that_is_no_instruction_is_refused_with_a_line(rig: Rig, text: str, complaint: str) -> None:
    rig.send(text)
    assert rig.taken(lambda: rig.lines) is None
    [line] = rig.lines
    assert line.startswith(f"instruction on {TOPIC} refused: ") and complaint in line


def test_a_flood_of_refused_texts_is_a_line_a_second(rig: Rig) -> None:
    for _ in range(40):
        rig.send("")
        rig.channel.poll()
        time.sleep(0.005)
    assert 1 <= len(rig.lines) <= 2


def test_a_stop_phrase_stops_the_robot_and_ends_the_channel(rig: Rig) -> None:
    rig.send("walk to the door", "STOP!")
    assert rig.taken(lambda: rig.channel.stopped) is None
    assert rig.stops == 1 and rig.lines == [f"stop phrase on {TOPIC}: the robot stands"]
    rig.send("walk to the door")
    assert rig.taken(lambda: len(rig.lines) > 1) is None
    assert "a stop phrase has ended this run" in rig.lines[1]


def test_a_stop_phrase_is_not_lost_among_a_hundred_later_texts(rig: Rig) -> None:
    rig.send("stop", *(f"turn left {index}" for index in range(100)))
    assert rig.taken(lambda: rig.channel.stopped) is None
    assert rig.stops == 1 and rig.checked == []


def test_of_a_hundred_texts_only_the_newest_is_checked_for_the_model(rig: Rig) -> None:
    rig.send(*(f"turn left {index}" for index in range(100)))
    assert rig.taken() == "turn left 99"
    assert rig.checked == ["turn left 99"]


@pytest.mark.slow
def test_any_bytes_are_an_instruction_or_a_refusal(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting: list[bytes] = []
    info = SimpleNamespace(valid_data=True)
    monkeypatch.setattr(bus_module, "take_undecoded", lambda reader: [(waiting.pop(), info)] if waiting else [])

    @settings(max_examples=200)
    @given(
        st.lists(st.one_of(st.binary(max_size=60), st.text().map(lambda text: String_(text).serialize())), max_size=6)
    )
    def holds(samples: list[bytes]) -> None:
        waiting[:] = samples
        found = rig.channel.poll()
        assert found is None or (found == " ".join(found.split()) and 0 < len(found) <= 400)

    holds()


class FakeChannel:
    """A channel that returns the texts of a list, one a poll."""

    def __init__(self, *texts: str | None, stopped: bool = False) -> None:
        self._texts, self.stopped, self.closed = list(texts), stopped, False

    def poll(self) -> str | None:
        return self._texts.pop(0) if self._texts else None

    def close(self) -> None:
        self.closed = True


def test_of_two_channels_either_brings_an_instruction() -> None:
    both = InstructionChannels(FakeChannel("a", None), FakeChannel(None, "b"))
    assert [both.poll() for _ in range(3)] == ["a", "b", None]


def test_a_stop_phrase_on_one_channel_ends_all() -> None:
    both = InstructionChannels(FakeChannel("a"), FakeChannel(stopped=True))
    assert both.stopped and both.poll() is None


def test_no_channel_brings_nothing_and_every_channel_is_closed() -> None:
    assert InstructionChannels().poll() is None and not InstructionChannels().stopped
    channels = FakeChannel(), FakeChannel()
    InstructionChannels(*channels).close()
    assert all(channel.closed for channel in channels)
