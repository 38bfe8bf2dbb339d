"""Checks of a ROS 2 base's topics: which nodes publish or subscribe to each, with which type and QoS, and the rates."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from edge.deploy.doctor.check import Check, Level, skipped
from edge.deploy.doctor.robot import LEAST_HZ
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.config_ros2 import RELIABLE, dds_topic
from firmware_bridge.core.robot_state import LinkOpenError

if TYPE_CHECKING:
    from firmware_bridge.dds.bus import Bus

MEASURE_S: Final = 2.0
"""Time for discovery and rates, s: twenty pictures at 10 Hz."""
INSTRUCTION: Final = "ros2.instruction"
_DEPTH: Final = 64  # samples that wait between two looks
_POLL_NS: Final = 20_000_000
_ENOUGH: Final = 0.8  # share of a wanted rate that a short measurement must show


@dataclass(frozen=True)
class TopicUse:
    """One topic of the robot file and what this machine needs of it.

    `topic`: its DDS name. `message`: its ROS type. `key`: the robot file's key. `commands`: we publish it. `alone`:
    a second publisher stops the robot. `least_hz`: rate below which the robot must not be driven; 0: none is needed.
    """

    key: str
    topic: str
    message: str
    reliable: bool
    commands: bool = False
    alone: bool = False
    least_hz: float = 0.0


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber of another program, as discovery announces it.

    `type_name`: the DDS type. `participant`: number of the program that it belongs to.
    """

    topic: str
    type_name: str
    publishes: bool
    reliable: bool
    participant: str = ""


@dataclass(frozen=True)
class Survey:
    """What was seen in the domain: the endpoints, and messages a second by DDS topic."""

    endpoints: Sequence[Endpoint]
    rates_hz: Mapping[str, float]


def topic_uses(robot: RobotConfig) -> list[TopicUse]:
    """Return the topics of a robot file with protocol ros2."""
    ros2 = robot.ros2
    if ros2 is None:
        return []
    reliable, command = ros2.reliable_inputs, f"geometry_msgs/msg/Twist{'Stamped' if ros2.stamped else ''}"
    # The bridge stops after 500 ms without an IMU message. A battery is too slow to be measured here.
    rows = [
        TopicUse("ros2.odometry", ros2.odometry, "nav_msgs/msg/Odometry", reliable, alone=True, least_hz=LEAST_HZ),
        TopicUse("ros2.imu", ros2.imu, "sensor_msgs/msg/Imu", reliable, alone=True, least_hz=2.0),
        TopicUse("ros2.battery", ros2.battery, "sensor_msgs/msg/BatteryState", reliable, alone=True),
        TopicUse(INSTRUCTION, ros2.instruction, "std_msgs/msg/String", reliable=True),
        TopicUse("ros2.command", ros2.command, command, ros2.command_reliability == RELIABLE, commands=True),
    ]
    uses = [replace(row, topic=ros2.topic(row.topic)) for row in rows if row.topic]
    kind, _, address = robot.camera.source.partition(":")
    if kind in ("ros2", "ros2raw"):
        message = f"sensor_msgs/msg/{'Image' if kind == 'ros2raw' else 'CompressedImage'}"
        least_hz = _ENOUGH * robot.camera.rate_hz
        uses.append(TopicUse("camera.source", dds_topic(address), message, reliable, least_hz=least_hz))
    return uses


def judge(use: TopicUse, survey: Survey) -> Check:
    """Judge one topic by what was seen."""
    name, shown = f"topic {use.topic.removeprefix('rt')}", use.message.replace("/msg/", "/")
    role = "subscriber" if use.commands else "publisher"
    expected = f"a {role} of {shown}"
    of_topic = [end for end in survey.endpoints if end.topic == use.topic]
    # A program that publishes commands and reads them looks for a second commander: the bridge.
    watching = {end.participant for end in of_topic if end.publishes} if use.commands else set()
    there = [end for end in of_topic if end.publishes != use.commands and end.participant not in watching]
    fitting = [end for end in there if end.type_name == dds_type(use.message)]
    # A reliable subscriber needs a reliable publisher; every other pair matches.
    if use.commands:
        matched = [end for end in fitting if use.reliable or not end.reliable]
    else:
        matched = [end for end in fitting if end.reliable or not use.reliable]
    if not there:
        if use.key == INSTRUCTION:
            return Check(name, Level.OK, "no publisher yet", expected)
        advice = f"start the node; compare {use.key}, ros2.namespace and [dds] with `ros2 topic info` on the robot"
        return Check(name, Level.FAIL, f"no {role} of any type", expected, advice)
    if not fitting:
        found = f"{len(there)} {role}s of {', '.join(sorted({ros_type(end.type_name) for end in there}))}"
        advice = "correct ros2.stamped" if use.commands else f"correct {use.key}: its type is fixed"
        return Check(name, Level.FAIL, found, expected, advice)
    if not matched:
        key, value = ("command", RELIABLE) if use.commands else ("input", "best_effort")
        found = f"{len(fitting)} {role}s whose QoS does not match"
        advice = f'write ros2.{key}_reliability = "{value}"'
        if use.key == INSTRUCTION:
            advice = "let the node publish it reliably: a lost stop phrase would not stop the robot"
        return Check(name, Level.FAIL, found, f"{expected} with a matching reliability", advice)
    return _judge_matched(use, name, expected, role, len(matched), survey.rates_hz.get(use.topic, 0.0))


def _judge_matched(use: TopicUse, name: str, expected: str, role: str, number: int, rate_hz: float) -> Check:
    found = f"{number} {role}{'s' if number > 1 else ''}"
    if use.commands:
        return Check(name, Level.OK, found, expected)
    found += f", {rate_hz:.1f} messages a second"
    if use.alone and number > 1:
        advice = "the bridge refuses to arm with two: leave one node that publishes it, or correct the topic"
        return Check(name, Level.FAIL, found, f"one publisher of {use.message.replace('/msg/', '/')}", advice)
    if rate_hz < use.least_hz:
        advice = "raise the node's rate; on a radio link, pictures are lost: compress them or use a cable"
        level = Level.WARN if use.key == "camera.source" and rate_hz > 0 else Level.FAIL
        return Check(name, level, found, f"{use.least_hz:g} messages a second or more", advice)
    return Check(name, Level.OK, found, expected)


def ros2_topics(
    robot: RobotConfig, look: Callable[[RobotConfig, Sequence[TopicUse]], Survey] | None = None
) -> list[Check]:
    """Check every topic of a robot file with protocol ros2; `look` looks at the domain."""
    uses = topic_uses(robot)
    try:
        survey = (look or survey_domain)(robot, uses)
    except (LinkOpenError, ModuleNotFoundError) as error:
        return [skipped("topics", str(error))]  # the check of the robot fails with the advice
    return [judge(use, survey) for use in uses]


def survey_domain(robot: RobotConfig, uses: Sequence[TopicUse], measure_s: float = MEASURE_S) -> Survey:
    """Join the domain for `measure_s` and count messages and endpoints; publishes nothing. Raises DdsError."""
    from firmware_bridge.dds.bus import Bus, take_bytes  # needs the extra of its protocol

    bus = Bus(robot.network)
    try:
        watch = _Endpoints(bus, {use.topic for use in uses})
        readers = {
            use.topic: bus.reader(use.topic, _message_class(use.message), depth=_DEPTH, reliable=use.reliable)
            for use in uses
            if not use.commands
        }
        counts, first_ns, last_ns = dict.fromkeys(readers, 0), dict.fromkeys(readers, 0), dict.fromkeys(readers, 0)
        end_ns = time.monotonic_ns() + round(measure_s * 1e9)
        while time.monotonic_ns() < end_ns:
            watch.poll()
            for topic, reader in readers.items():
                for _ in take_bytes(reader, _DEPTH):
                    last_ns[topic] = time.monotonic_ns()
                    first_ns[topic] = first_ns[topic] or last_ns[topic]
                    counts[topic] += 1
            time.sleep(_POLL_NS / 1e9)
        spans_s = {topic: max(last_ns[topic] - first_ns[topic], _POLL_NS) / 1e9 for topic in readers}
        # Between the first and the last message: discovery takes a part of the time.
        rates_hz = {
            topic: (count - 1) / spans_s[topic] if count > 2 else count / measure_s for topic, count in counts.items()
        }
        return Survey(watch.found(), rates_hz)
    finally:
        bus.close()


class _Endpoints:
    """Publishers and subscribers of some topics, by discovery; those of this participant are left out."""

    def __init__(self, bus: Bus, topics: set[str]) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        self._own, self._topics = str(bus.participant.guid), topics
        kinds = ((BuiltinTopicDcpsPublication, True), (BuiltinTopicDcpsSubscription, False))
        self._readers: list[tuple[Any, bool]] = [
            (BuiltinDataReader(bus.participant, kind), publishes) for kind, publishes in kinds
        ]
        self._found: dict[str, Endpoint] = {}

    def poll(self) -> None:
        """Take what discovery has announced since the last call."""
        from cyclonedds.qos import Policy

        for reader, publishes in self._readers:
            for sample in reader.take(_DEPTH):
                key = str(sample.key)
                if not sample.sample_info.valid_data:  # it has ended
                    self._found.pop(key, None)
                elif str(sample.participant_key) != self._own and sample.topic_name in self._topics:
                    reliable = isinstance(sample.qos[Policy.Reliability], Policy.Reliability.Reliable)
                    program = str(sample.participant_key)
                    self._found[key] = Endpoint(sample.topic_name, sample.type_name, publishes, reliable, program)

    def found(self) -> list[Endpoint]:
        """Return the endpoints that are there now."""
        return list(self._found.values())


def dds_type(message: str) -> str:
    """Return the DDS name of a ROS type: `nav_msgs::msg::dds_::Odometry_` of `nav_msgs/msg/Odometry`."""
    package, _, name = message.split("/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(type_name: str) -> str:
    """Return a DDS type as ROS users write it; a name of another form, at most 60 characters of it, as it is."""
    parts = type_name.split("::")
    return f"{parts[0]}/{parts[3].removesuffix('_')}" if len(parts) == 4 else type_name[:60]


def _message_class(message: str) -> Any:
    from firmware_bridge.ros2.messages import common, navigation, sensors

    name = f"{message.rpartition('/')[2]}_"
    return next(getattr(module, name) for module in (common, navigation, sensors) if hasattr(module, name))
