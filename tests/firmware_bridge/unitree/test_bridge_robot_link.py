"""What the bridge takes from the robot's network in one step: few samples, small ones, and the stop keys always."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

from firmware_bridge.core.config import DdsConfig, load_robot_config
from firmware_bridge.core.step_types import Report
from firmware_bridge.dds.bus import DDS_ERRORS, Bus, take_each
from firmware_bridge.unitree import robot_link
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import (
    Request_,
    RequestIdentity_,
    Response_,
    ResponseHeader_,
    ResponseStatus_,
    WirelessController_,
)
from firmware_bridge.unitree.requests import make_request
from firmware_bridge.unitree.robot_link import RobotLink
from tests.support.processes import GO2_SIM, wait_for

FOUR_MB = "x" * 4_000_000
L2_B = 1 << 5 | 1 << 9


def answer(data: str) -> Response_:
    return Response_(ResponseHeader_(RequestIdentity_(1, 1), ResponseStatus_(0)), data, b"")


@pytest.fixture
def bus(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bus]:
    """Reads what this process writes too, and keeps what is large: cheaper than a process that writes."""
    reader = Bus.reader
    monkeypatch.setattr(Bus, "reader", lambda self, *given, **named: reader(self, *given, **named | {"foreign": False}))
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)), max_sample_bytes=10_000_000)
    monkeypatch.setattr(robot_link, "Bus", lambda *_, **__: bus)
    yield bus
    bus.close()


@pytest.fixture
def link(bus: Bus, dds_domain: int) -> RobotLink:
    return RobotLink(load_robot_config(GO2_SIM, domain=dds_domain), lambda _: None)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the requests and responses that were decoded."""
    sizes: list[int] = []
    for kind in (Request_, Response_):

        def deserialize(data: bytes, *given: Any, real: Any = kind.deserialize, **named: Any) -> Any:
            sizes.append(len(data))
            return real(data, *given, **named)

        monkeypatch.setattr(kind, "deserialize", deserialize)
    return sizes


def read_until(link: RobotLink, done: Any) -> Report:
    reports: list[Report] = []

    def read() -> bool:
        reports.append(link.read(0))
        return bool(done(reports[-1]))

    wait_for(read, 5, "a report")
    return reports[-1]


def test_an_answer_of_four_megabytes_is_counted_and_not_decoded(bus: Bus, link: RobotLink, decoded: list[int]) -> None:
    bus.writer(ids.response_topic(ids.SPORT_SERVICE), Response_).write(answer(FOUR_MB))
    read_until(link, lambda _: link.dropped()[0] == 1)
    assert decoded == []


def test_a_request_of_four_megabytes_is_a_second_commander_and_not_decoded(
    bus: Bus, link: RobotLink, decoded: list[int]
) -> None:
    writer = bus.writer(ids.request_topic(ids.SPORT_SERVICE), Request_)
    writer.write(make_request(1, ids.MOVE, FOUR_MB, noreply=True))
    assert read_until(link, lambda report: report.foreign).foreign == "sport unreadable request"
    assert decoded == []


def test_a_step_takes_a_few_samples_of_a_topic_and_the_next_ones_the_rest(
    bus: Bus, link: RobotLink, decoded: list[int]
) -> None:
    writer = bus.writer(ids.response_topic(ids.SPORT_SERVICE), Response_, depth=8)
    for _ in range(8):
        writer.write(answer("small"))
    each = []
    for _ in range(3):
        before = len(decoded)
        link.read(0)
        each.append(len(decoded) - before)
    assert each == [4, 4, 0]


@pytest.mark.parametrize("stick", [math.nan, 1.6, -1e30, math.inf])
def test_the_stop_keys_count_with_any_stick_position(bus: Bus, link: RobotLink, stick: float) -> None:
    bus.writer(ids.REMOTE_TOPIC, WirelessController_).write(WirelessController_(0.0, stick, 0.0, 0.0, L2_B))
    assert read_until(link, lambda report: report.remote_estop).remote_estop
    assert link.dropped()[0] == 1


def test_the_battery_is_read_in_every_step_until_it_has_reported(
    link: RobotLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    topics: list[str] = []
    monkeypatch.setattr(
        robot_link, "take_each", lambda reader, *given: topics.append(reader.topic.name) or take_each(reader, *given)
    )
    for _ in range(3):
        link.read(0)
    assert topics.count(ids.LF_LOW_STATE_TOPIC) == 3


def test_a_message_larger_than_the_reader_limit_is_dropped_by_dds(dds_domain: int) -> None:
    """Seen at a writer of the same process; the rule is one of the whole participant."""
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)), max_sample_bytes=1_000_000)
    writer = bus.writer(ids.response_topic(ids.SPORT_SERVICE), Response_)
    writer.write(answer("x" * 900_000))
    with pytest.raises(DDS_ERRORS):
        writer.write(answer("x" * 1_100_000))
    bus.close()
