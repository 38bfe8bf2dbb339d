"""What every protocol's robot half promises to a client, as one test class; a protocol's own test derives from it.

Time is the robot's: physics steps are made as fast as they go, and nothing here waits for a clock, only for the wire.
The client's messages go through real sockets.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import pytest

from sim_hil.protocols.front_end import FrontEnd, FrontEndOptions, ReceivedCommand
from sim_hil.scene.scene import load_scene
from sim_hil.simulation.physics import Simulation

SERVE_EVERY = 2  # steps, as in the real loop
_WIRE_TIMEOUT_S = 10.0


class Report(NamedTuple):
    """One odometry report as the client received it: the robot's stamp, pose since its start, forward speed."""

    stamp_s: float
    x_m: float
    y_m: float
    theta_rad: float
    vx_mps: float


class Client(Protocol):
    """The other end of the wire. Sends at once; what it has received is taken in by `poll`."""

    @property
    def reports(self) -> list[Report]: ...

    def poll(self) -> None: ...

    def get_ready(self) -> None:
        """Ask the robot to stand up, or to be armed."""

    def is_ready(self) -> bool:
        """Whether the robot says that it would obey."""

    def drive(self, vx_mps: float, wz_radps: float) -> None: ...

    def stop(self) -> None: ...

    def emergency_stop(self) -> None: ...

    def send_garbage(self) -> None:
        """Send something that this protocol must count as malformed."""

    def close(self) -> None: ...


@dataclass
class Rig:
    """A simulated robot, its front end and a client, in one process."""

    simulation: Simulation
    front_end: FrontEnd
    client: Client
    steps: int = 0

    def run(self, seconds: float, each_tenth: Callable[[], object] = lambda: None) -> None:
        """Let the robot's time pass; `each_tenth` is called every 0.1 s of it."""
        tenth = self.simulation.rate_hz // 10
        for _ in range(round(seconds * self.simulation.rate_hz)):
            if self.steps % tenth == 0:
                each_tenth()
                self.client.poll()
                self.let_arrive()
            if self.steps % SERVE_EVERY == 0:
                self.front_end.serve()
            self.simulation.step()
            self.steps += 1
            self.front_end.publish(self.steps, self.steps * self.simulation.dt_s)

    def let_arrive(self) -> None:
        """Wait until the front end has what the client has sent; for a wire on which that may take long."""

    def tell(self, say: Callable[[], object]) -> list[ReceivedCommand]:
        """Let the client say something and the robot hear it."""
        say()
        deadline = time.monotonic() + _WIRE_TIMEOUT_S
        heard: list[ReceivedCommand] = []
        while not heard:
            assert time.monotonic() < deadline, "the front end heard nothing"
            self.front_end.wait(10_000_000)
            heard = self.front_end.serve()
        return heard

    def until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Let the robot's time pass until `condition()`."""
        for _ in range(round(seconds * 10)):
            if condition():
                return
            self.run(0.1)
            time.sleep(0.005)  # the wire needs real time
            self.client.poll()
        assert condition(), f"not within {seconds} s of the robot's time: {what}"

    def make_ready(self) -> None:
        self.tell(self.client.get_ready)
        self.until(self.client.is_ready, 15.0, "the robot is ready")

    def place(self) -> tuple[float, float]:
        (x, y, _), _ = self.simulation.pose()
        return x, y

    def speed_mps(self) -> float:
        vx, vy, _ = self.simulation.truth().velocity_world_mps
        return math.hypot(vx, vy)

    def close(self) -> None:
        self.client.close()
        self.front_end.close()
        self.simulation.close()


def options(robot: str, **changes: object) -> FrontEndOptions:
    """A corridor without people, camera and noise, with `changes`."""
    values: dict[str, object] = {
        "robot": robot, "scene_source": "corridor", "scene": load_scene("corridor"), "people": 0, "seed": 0,
        "camera_size": None, "odometry_noise": "none", "faults": None, "link": None, "domain": 0, "interface": "lo",
    }  # fmt: skip
    return FrontEndOptions(**{**values, **changes})  # type: ignore[arg-type]


class FrontEndContract:
    """Derive from it and define `rig`: a fresh robot and a client that it already hears."""

    SPEED_MPS = 0.4

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        raise NotImplementedError

    def test_it_gets_ready_on_request_and_stays_where_it_is(self, rig: Rig) -> None:
        before = rig.place()
        assert not rig.client.is_ready()
        rig.make_ready()
        assert math.dist(before, rig.place()) < 0.15
        assert not rig.simulation.fell

    def test_it_follows_a_velocity_and_stops(self, rig: Rig) -> None:
        rig.make_ready()
        start = rig.place()
        rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0))
        rig.run(3.0, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
        end = rig.place()
        assert math.dist(start, end) > 0.6 * 3.0 * self.SPEED_MPS
        rig.tell(rig.client.stop)
        rig.run(1.5)
        assert rig.speed_mps() < 0.06
        assert math.dist(end, rig.place()) < 0.35

    def test_it_turns_to_the_left_for_a_positive_rate(self, rig: Rig) -> None:
        rig.make_ready()
        _, before = rig.simulation.pose()
        rig.run(2.0, lambda: rig.tell(lambda: rig.client.drive(0.0, 0.5)))
        _, after = rig.simulation.pose()
        assert 0.4 < after - before < 1.4

    def test_a_command_that_is_not_repeated_ends(self, rig: Rig) -> None:
        rig.make_ready()
        rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0))
        start = rig.place()
        rig.run(3.0)
        assert math.dist(start, rig.place()) > 0.02
        assert rig.speed_mps() < 0.06
        assert rig.simulation.commanded == (0.0, 0.0, 0.0)

    def test_reports_have_advancing_stamps_and_the_driven_distance(self, rig: Rig) -> None:
        rig.make_ready()
        rig.client.reports.clear()
        start = rig.place()
        rig.run(2.0, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
        moved_m = math.dist(start, rig.place())
        rig.until(lambda: rig.client.reports[-1].stamp_s >= rig.steps * rig.simulation.dt_s - 0.2, 2.0, "the newest")
        reports = rig.client.reports
        stamps = [report.stamp_s for report in reports]
        assert len(stamps) > 10 and all(a < b for a, b in itertools.pairwise(stamps))
        first, last = reports[0], reports[-1]
        assert math.hypot(last.x_m - first.x_m, last.y_m - first.y_m) == pytest.approx(moved_m, abs=0.15)
        assert max(report.vx_mps for report in reports) == pytest.approx(self.SPEED_MPS, abs=0.2)

    def test_malformed_input_is_counted_and_harmless(self, rig: Rig) -> None:
        rig.make_ready()
        before = rig.place()
        assert _malformed(rig) == 0
        rig.client.send_garbage()
        rig.until(lambda: _malformed(rig) > 0, 5.0, "the malformed input to be counted")
        rig.run(0.5)
        assert math.dist(before, rig.place()) < 0.1
        rig.run(1.5, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
        assert math.dist(before, rig.place()) > 0.2

    def test_an_emergency_stop_stops_it_and_lasts(self, rig: Rig) -> None:
        rig.make_ready()
        rig.run(1.0, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
        rig.tell(rig.client.emergency_stop)
        rig.run(1.5)
        where = rig.place()
        rig.run(1.5, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
        assert math.dist(where, rig.place()) < 0.05
        assert rig.simulation.commanded == (0.0, 0.0, 0.0)

    def test_the_result_has_the_last_command(self, rig: Rig) -> None:
        rig.make_ready()
        rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0))
        wire = rig.front_end.summary()["wire"]
        assert wire["commands"] >= 1 and wire["last_command_zero"] is False
        assert wire["last_move"] == pytest.approx([self.SPEED_MPS, 0.0, 0.0], abs=0.01)
        rig.tell(rig.client.stop)
        assert rig.front_end.summary()["wire"]["last_command_zero"] is True


def _malformed(rig: Rig) -> int:
    count = rig.front_end.summary()["wire"]["malformed"]
    assert isinstance(count, int)
    return count
