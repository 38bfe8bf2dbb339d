"""The bridge's end of the robot's network: one `Report` of the received messages per step, and written requests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from cyclonedds.sub import DataReader

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import BatteryState, RobotState, StampOrder, within
from firmware_bridge.core.step_types import Identify, Move, Report, Request, Stand
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.dds.publishers import PublisherWatch
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import Request_, SportModeState_, WirelessController_
from firmware_bridge.unitree.messages.idl_low import LowState_
from firmware_bridge.unitree.remote import StopKeys
from firmware_bridge.unitree.report import battery_state, robot_state
from firmware_bridge.unitree.requests import Requester, move_parameter

_MAX_UNANSWERED: Final = 32
_MAX_VERSION_CHARS: Final = 40
_FAILING_WRITES: Final = 3  # in a row: 60 ms at 50 Hz, inside the 100 ms of fault matrix row 46
_BATTERY_PERIOD_NS: Final = 1_000_000_000  # decoding a low state costs as much as ten other messages
_MAX_STICK: Final = 1.5  # full travel is 1
_FEW: Final = 4  # samples of one topic per step: 200 a second, each decoded quickly
_MAX_BYTES: Final = 4096  # a low state, the largest message read here, has 1180
_MAX_KEPT_BYTES: Final = 1024 * 1024  # times 51, the depth of all readers: far below the service's MemoryMax


class RobotLink:
    """All readers and the only writer; no method waits. Raises DdsError when the DDS domain cannot be joined."""

    def __init__(self, config: RobotConfig, report: Callable[[str], None]) -> None:
        """`report` takes one line when the robot answers a request with an error."""
        self._report = report
        self._velocity_frame = config.odometry.velocity_frame
        self._deadband = config.safety.remote_deadband
        self._stop_keys = StopKeys(config.safety.remote_estop_keys)
        self._bus = bus = Bus(config.network, max_sample_bytes=_MAX_KEPT_BYTES)
        self._sport = Requester(bus, ids.SPORT_SERVICE, allowed=ids.BRIDGE_ALLOWED)
        self._states = bus.reader(ids.SPORT_STATE_TOPIC, SportModeState_)
        self._low_states = bus.reader(ids.LF_LOW_STATE_TOPIC, LowState_)
        self._remotes = bus.reader(ids.REMOTE_TOPIC, WirelessController_, depth=8)
        self._requests = [
            (service, harmless, bus.reader(ids.request_topic(service), Request_, depth=8, foreign=True))
            for service, harmless in ids.COMMANDING_SERVICES.items()
        ]
        self._publishers = PublisherWatch(bus, ids.trusted_publishers(config.safety.robot_lowcmd_publishers))
        self._order = StampOrder()
        self._battery_due_ns = 0
        self._sent: dict[int, int] = {}  # request id -> api id of unanswered requests
        self._malformed = 0

    def dropped(self) -> tuple[int, int, int]:
        """Return counts so far: impossible messages, states out of order, requests that the network did not accept."""
        return self._malformed + self._sport.malformed, self._order.dropped, self._sport.failed_writes

    def read(self, now_ns: int) -> Report:
        """Return the report of all messages since the last call."""
        in_use, estop = self._remote(now_ns)
        state, foreign, battery = self._newest_state(), self._foreign(), self._newest_battery(now_ns)
        version, denied = self._answers()
        failing = self._sport.failing >= _FAILING_WRITES
        publishers = self._publishers.surplus()
        return Report(state, in_use, estop, foreign, denied, publishers, battery, version, failing)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()

    def write(self, request: Request) -> None:
        """Send one request without waiting. A request that the network does not accept is counted."""
        if isinstance(request, Move):
            parameter = move_parameter(request.vx_mps, request.vy_mps, request.wz_radps)
            self._sport.send(ids.MOVE, parameter, noreply=True)
            return
        api_id = ids.STOP_MOVE
        if isinstance(request, (Identify, Stand)):
            api_id = ids.API_VERSION if isinstance(request, Identify) else request.step
        if (request_id := self._sport.send(api_id)) is not None:
            if len(self._sent) >= _MAX_UNANSWERED:
                self._sent.clear()
            self._sent[request_id] = api_id

    def _newest_state(self) -> RobotState | None:
        newest = None
        for sample in _few(self._states):
            state = None if sample is None else robot_state(sample, time.monotonic_ns(), self._velocity_frame)
            if state is None:
                self._malformed += 1
            elif self._order.accept(state):
                newest = state
        return newest

    def _remote(self, now_ns: int) -> tuple[bool, bool]:
        """Return whether a stick or key is in use, and whether the emergency-stop keys were pressed together."""
        in_use = estop = False
        for sample in _few(self._remotes):
            if sample is None:
                self._malformed += 1
                continue
            estop |= self._stop_keys.press(sample.keys, now_ns)  # whatever the sticks report
            if within(_MAX_STICK, sample.lx, sample.ly, sample.rx, sample.ry):
                in_use |= sample.keys != 0 or not within(self._deadband, sample.lx, sample.ly, sample.rx, sample.ry)
            else:
                self._malformed += 1
        return in_use, estop

    def _foreign(self) -> str | None:
        foreign = None
        for service, harmless, reader in self._requests:
            for sample in _few(reader):
                api_id = "unreadable request" if sample is None else sample.header.identity.api_id
                if api_id not in harmless:
                    foreign = f"{service} {api_id}"
        return foreign

    def _newest_battery(self, now_ns: int) -> BatteryState | None:
        if now_ns < self._battery_due_ns:
            return None
        battery = None
        for sample in _few(self._low_states):
            battery = None if sample is None else battery_state(sample, now_ns)
            self._malformed += battery is None
            self._battery_due_ns = now_ns + _BATTERY_PERIOD_NS
        return battery

    def _answers(self) -> tuple[str | None, str | None]:
        """Return the sport service's version and the request that it has denied; report errors to the operator."""
        version = denied = None
        for answer in self._sport.responses(_FEW, _MAX_BYTES):
            api_id = self._sent.pop(answer.request_id, None)
            if api_id is not None and answer.code != ids.OK:
                denied = ids.SPORT_API_NAMES[api_id] if answer.code in ids.LEASE_ERRORS else denied
                self._report(f"the robot answered {ids.SPORT_API_NAMES[api_id]} with error {answer.code}")
            elif api_id == ids.API_VERSION:
                version = answer.data[:_MAX_VERSION_CHARS] or "nothing"
        return version, denied


def _few(reader: DataReader[Any]) -> Iterator[Any]:
    return take_each(reader, _FEW, _MAX_BYTES)
