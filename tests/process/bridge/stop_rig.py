"""A bridge process between clients of this process and a robot that walks; times and distances are the robot's."""

from __future__ import annotations

import contextlib
import io
import json
import statistics
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclonedds.domain import DomainParticipant

from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from firmware_bridge.dds.bus import Bus
from firmware_bridge.operate import operate
from firmware_bridge.unitree.messages import ids
from tests.support.processes import GO2_SIM, REPOSITORY, Running, running, wait_for
from tests.support.robot.fake_go2 import FakeGo2

ZERO = (0.0, 0.0, 0.0)
STANDING_UP = frozenset({ids.STAND_UP, ids.RECOVERY_STAND, ids.BALANCE_STAND})
REST_MPS = 0.05
L2, B = 1 << 5, 1 << 9
SPEED_MPS = 0.8
MANY = 20
REPETITIONS = pytest.mark.parametrize(
    "repetitions", [1, pytest.param(MANY, marks=[pytest.mark.repeated, pytest.mark.timeout(900)])]
)


class Peer(Bus):
    """One more participant of this process in a domain that it has opened already: another machine's program."""

    def __init__(self, domain: int) -> None:
        self.participant = DomainParticipant(domain)
        self._topics, self._topics_lock = {}, threading.Lock()

    def close(self) -> None:
        """Leave the domain now; its publishers are announced as gone."""
        self.participant._delete(self.participant._ref)


class Driver:
    """A runner: asks to arm once a second until it drives, then commands `vx_mps` at 20 Hz."""

    def __init__(self, socket: Path, vx_mps: float = SPEED_MPS) -> None:
        self._client = BridgeClient(socket)
        self._vx_mps = vx_mps
        self._ending = threading.Event()
        self.status: BridgeStatus | None = None
        self.asked = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        seq, driven, asked_s = 0, False, -1.0
        with contextlib.suppress(BridgeUnavailable):
            while not self._ending.wait(0.05):
                self.status = status = self._client.poll()
                armed = status is not None and status.state == "armed"
                driven = driven or armed
                if not driven and time.monotonic() - asked_s >= 1.0:
                    self._client.arm()
                    self.asked, asked_s = True, time.monotonic()
                seq += 1
                self._client.send_velocity(seq, time.monotonic_ns(), self._vx_mps if armed else 0.0, 0.0, 0.0)

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._client.close()

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Terminal(io.StringIO):
    """Standard error that notes when its first line came."""

    first_ns = 0

    def write(self, text: str) -> int:
        self.first_ns = self.first_ns or time.monotonic_ns()
        return super().write(text)


class Rig:
    """One robot and one bridge process; `latch` is the bridge's latch file."""

    def __init__(self, robot: FakeGo2, domain: int, folder: Path) -> None:
        self.robot, self.domain, self.folder = robot, domain, folder
        self.first_line_ns = 0
        self.socket, self.latch = folder / "bridge.sock", folder / "bridge.sock.latch"

    def reset(self) -> None:
        """A robot that stands, walks as commanded and has received nothing."""
        self.robot.reset()
        self.robot.mode, self.robot.walks = ids.MODE_BALANCE_STAND, True

    def bridge(self, name: str = "bridge", *more: object) -> contextlib.AbstractContextManager[Running]:
        folder = self.folder / name
        folder.mkdir(exist_ok=True)
        arguments = ("--robot", GO2_SIM, "--domain", self.domain, "--socket", self.socket, *more)
        return running("firmware_bridge.bridge", *arguments, folder=folder)

    def driver(self, vx_mps: float = SPEED_MPS) -> Driver:
        return Driver(self.socket, vx_mps)

    def operate(self, command: str) -> tuple[int, dict[str, object], str]:
        """Exit code, status and what was written to stderr."""
        with contextlib.redirect_stderr(_Terminal()) as error:
            code, values = operate(command, self.socket)
        self.first_line_ns = error.first_ns
        return code, values, error.getvalue()

    def arm_for(self, driver: Driver) -> None:
        """An operator's arm as soon as the bridge would take it."""
        wait_for(lambda: driver.asked, 5, "a runner that waits")
        wait_for(lambda: self.operate("arm")[0] == 0, 10, "an accepted `edge-bridge arm`")

    @contextlib.contextmanager
    def driving(self, vx_mps: float = SPEED_MPS) -> Iterator[Driver]:
        """A runner that drives the robot at full speed; after an emergency stop an operator lets it."""
        self.reset()
        time.sleep(0.1)
        with self.driver(vx_mps) as driver:
            if self.operate("status")[1]["permit"] != "not needed":
                self.arm_for(driver)
            wait_for(lambda: self.robot.speed_mps > 0.9 * vx_mps, 20, "a robot at full speed")
            yield driver

    def moved_since(self, since_ns: int) -> bool:
        """Whether the robot has received a command that moves it."""
        return any(
            one.received_ns > since_ns and (one.api_id in STANDING_UP or one.velocity not in (None, ZERO))
            for one in list(self.robot.received)
        )

    def zero_after_ms(self, since_ns: int, timeout_s: float = 3.0) -> float:
        """From `since_ns` until the first zero Move after which only zeros came for 0.3 s."""
        received = self.robot.received

        def first() -> int | None:
            moves = [one for one in list(received) if one.velocity is not None and one.received_ns > since_ns]
            last = max((index for index, one in enumerate(moves) if one.velocity != ZERO), default=-1)
            return moves[last + 1].received_ns if last + 1 < len(moves) else None

        wait_for(lambda: first() is not None, timeout_s, "zero velocity")
        time.sleep(0.3)
        found = first()
        assert found is not None, "no lasting zero velocity"
        return (found - since_ns) / 1e6

    def rest_after(self, since_ns: int) -> tuple[float, float]:
        """Milliseconds and metres from `since_ns` until the robot was at rest, by its own track."""
        wait_for(lambda: self.robot.speed_mps < REST_MPS, 5, "a robot at rest")
        track = self.robot.track_since(since_ns)
        rest_ns, _, distance_m = next(point for point in track if point[1] < REST_MPS)
        return (rest_ns - since_ns) / 1e6, distance_m - track[0][2]


def report(name: str, values: dict[str, list[float]]) -> None:
    """Print median, largest value and n of each series, and add them to out/stop_proofs.json."""
    found = {
        key: {"p50": round(statistics.median(series), 3), "max": round(max(series), 3), "n": len(series)}
        for key, series in values.items()
    }
    print(f"{name}: {json.dumps(found)}")  # noqa: T201
    path = REPOSITORY / "out" / "stop_proofs.json"
    path.parent.mkdir(exist_ok=True)
    table = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps({**table, name: found}, indent=2) + "\n")
