"""The fault harness without processes: what counts as a stop, and which rows pass."""

from __future__ import annotations

import json
import math
import random
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.core.geometry import SE2
from edge.motion.controller import arc_to
from edge.safety.faults.table import FAULTS
from firmware_bridge.core.config import load_robot_config
from sim_hil.protocols.can.node import COMMAND_TIMEOUT_S
from sim_hil.protocols.fault_socket import FaultClient, FaultError
from sim_hil.protocols.mavlink.parameters import TABLE
from sim_hil.protocols.ros2.front_end import BASE_TIMEOUT_S
from sim_hil.realtime.robots import ROBOTS, StackRobot
from tests.support.processes import wait_for
from tools.faults import __main__ as command
from tools.faults import measure
from tools.faults.measure import Sample
from tools.faults.report import RowResult, markdown, read_results, result
from tools.faults.rig import circle, driver
from tools.faults.rig.busy import busy_processes, paused
from tools.faults.rig.received import ReceivedCommands, first_lasting, longest_age_ms, longest_gap_ms
from tools.faults.rig.switches import Switches
from tools.faults.rows import CONTRACT, NOT_INJECTED, Judge, Row, rows

MS = 1_000_000
ZERO, SLOW, FAST = (0.0, 0.0, 0.0), (0.3, 0.0, 0.2), (0.7, 0.0, 0.7)


@pytest.mark.parametrize(
    ("commands", "limit", "first"),
    [
        ([FAST, ZERO, FAST, ZERO, ZERO], ZERO, 3),
        ([ZERO, FAST], ZERO, None),
        ([FAST, SLOW, ZERO, SLOW], (0.4, math.inf, math.inf), 1),
    ],
    ids=["a stop is the first zero after the last motion", "a robot that moves at the end", "a speed limit"],
)
def test_a_reaction_counts_from_the_first_command_after_the_last_that_breaks_it(
    commands: list[tuple[float, float, float]], limit: tuple[float, float, float], first: int | None
) -> None:
    assert first_lasting(list(enumerate(commands)), limit) == first


def test_a_gap_counts_from_the_beginning_and_to_the_end_of_the_window() -> None:
    assert longest_gap_ms([(30 * MS, FAST), (50 * MS, FAST)], 0, 60 * MS) == 30.0
    assert longest_gap_ms([(30 * MS, FAST)], 0, 100 * MS) == 70.0
    assert longest_gap_ms([], 0, 100 * MS) == 100.0


@pytest.mark.parametrize(
    ("received", "obeys", "age_ms"),
    [
        ([0, 20, 40, 60, 80], [(-5, True)], 20.0),
        ([0, 20], [(-5, True), (50, False)], 30.0),
        ([0, 20], [(-5, True), (50, False), (90, True)], 80.0),
        ([0], [(-5, True), (5, False)], 0.0),
        ([0], [(-5, True)], 100.0),
    ],
    ids=[
        "commands at 50 Hz",
        "a robot that stops by itself",
        "a robot that obeys an old command again",
        "a robot that stood before the window",
        "a robot that drives on without a command",
    ],
)
def test_the_age_of_a_command_counts_only_while_the_robot_obeys_motion(
    received: list[int], obeys: list[tuple[int, bool]], age_ms: float
) -> None:
    stamps, changes = [t * MS for t in received], [(t * MS, moving) for t, moving in obeys]
    assert longest_age_ms(stamps, changes, 10 * MS, 100 * MS) == age_ms


def row(bound: float = 300.0) -> Row:
    return Row("test", None, lambda rig: 0, judge=Judge.ZERO, bound=bound)


@pytest.mark.parametrize(
    ("sample", "problem"),
    [
        (Sample(290.0, 0.0), None),
        (Sample(310.0, 0.0), "p99.9 above 300 ms"),
        (Sample(310.0, 20.0), None),
        (Sample(340.0, 20.0), "p99.9 above 300 ms"),
        (Sample(601.0, 0.0), "max above 600 ms"),
        (Sample(None, 0.0), "1 never came"),
        (Sample(10.0, 0.0, ["moved after SIGCONT"]), "moved after SIGCONT"),
    ],
)
def test_a_row_passes_when_every_sample_is_within_the_bound(sample: Sample, problem: str | None) -> None:
    problems = RowResult(row(), [Sample(100.0, 0.0)] * 5 + [sample]).problems
    assert (problem is None and not problems) or problem in problems


def test_on_a_disk_too_full_to_record_to_nothing_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("edge.flightlog.recorder._free", lambda _: (69 << 30, 1000 << 30))
    monkeypatch.setattr(command, "Rig", lambda *_: pytest.fail("a rig was made"))
    monkeypatch.setattr(command, "read_manifest", lambda _: None)
    assert command.main(["--artifacts", str(tmp_path), "--out", str(tmp_path / "out"), "--domain", "1"]) == 1
    assert "recording needs 71680 MiB" in capsys.readouterr().err


def test_time_that_the_machine_stood_still_is_granted_and_counted() -> None:
    result = RowResult(row(), [Sample(310.0, 20.0), Sample(100.0, 20.0)])
    assert result.granted == 1 and result.as_json()["max_ms"] == 310.0


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_every_robot_has_rows_of_its_own_and_of_the_contract(robot: StackRobot) -> None:
    names = [one.name for one in rows(robot)]
    assert len(set(names)) == len(names)
    assert {"runner SIGKILL", "bridge SIGSTOP", "link dead both ways", "battery at 3 %"} <= CONTRACT.intersection(names)


def test_every_row_of_the_contract_belongs_to_a_robot() -> None:
    assert {one.name for robot in ROBOTS.values() for one in rows(robot)} >= CONTRACT


def test_the_timeout_that_a_row_expects_of_a_robot_is_the_simulated_ones() -> None:
    assert ROBOTS["carter-can"].own_timeout_s == COMMAND_TIMEOUT_S
    assert ROBOTS["carter-mavlink"].own_timeout_s == TABLE["COM_OF_LOSS_T"].default
    assert ROBOTS["carter-ros2"].own_timeout_s == BASE_TIMEOUT_S


def test_a_robot_stops_by_itself_no_later_than_its_robot_file_states() -> None:
    can, ros2, mavlink = (load_robot_config(ROBOTS[f"carter-{name}"].file) for name in ("can", "ros2", "mavlink"))
    assert can.can is not None and ros2.ros2 is not None and mavlink.mavlink is not None
    assert 1000 * ROBOTS["carter-can"].own_timeout_s <= can.can.command.base_timeout_ms
    assert 1000 * ROBOTS["carter-ros2"].own_timeout_s <= ros2.ros2.base_timeout_ms
    assert ROBOTS["carter-mavlink"].own_timeout_s <= mavlink.mavlink.setpoint_loss_max_s


def test_a_resumed_call_reads_the_rows_that_it_had_written(tmp_path: Path) -> None:
    one = RowResult(rows()[0], [Sample(100.0, 1.0), Sample(None, 0.0, ["wrong"])], 1, 7.5)
    (tmp_path / "faults.json").write_text(json.dumps(result([one], {}, "go2")))
    [read] = read_results(tmp_path / "faults.json", rows())
    assert read.as_json() == one.as_json() and read.row.name == one.row.name
    assert read_results(tmp_path / "none.json", rows()) == []
    (tmp_path / "faults.json").write_text("[]")
    with pytest.raises(ValueError, match="leave out --resume"):
        read_results(tmp_path / "faults.json", rows())


def test_a_resumed_row_makes_only_the_missing_injections(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    monkeypatch.setattr(command, "attempt", lambda *_: made.append(1) or Sample(50.0, 0.0))
    counts: list[int] = []
    kept = RowResult(row(), [Sample(100.0, 0.0)] * 3, 1)
    arguments: tuple[Any, ...] = (None, row(), 5, random.Random(0), None)
    done = command.run_row(*arguments, kept=kept, keep=lambda one: counts.append(len(one.samples)))
    assert len(made) == 2 and counts == [4, 5] and len(done.samples) == 5 and done.repeated == 1
    assert len(command.run_row(*arguments, kept=done).samples) == 5 and len(made) == 2


def test_the_table_has_a_row_for_each_fault_and_a_column_for_each_robot() -> None:
    go2 = result([RowResult(rows()[0], [Sample(100.0, 0.0), Sample(200.0, 0.0)], 0, 1.0)], {}, "go2")
    can = result([RowResult(replace(row(), name="other"), [Sample(400.0, 0.0)], 0, 2.0)], {}, "carter-can")
    assert markdown([go2, can]).splitlines() == [
        "| fault | judged | go2 | carter-can |",
        "|---|---|---|---|",
        "| camera stops | zero | ≤ 500: 200 / 200 / 200, n 2 | – |",
        "| other | zero | – | ≤ 300: 400 / 400 / 400, n 1 **failed** |",
        "",
        "Load of the machine (1 min): go2 1.0 to 1.0, carter-can 2.0 to 2.0.",
    ]


def test_under_load_a_stall_of_the_machine_is_not_granted() -> None:
    assert RowResult(row(), [Sample(310.0, 20.0)], busy=2).problems == [
        "p99.9 above 300 ms",
    ]
    assert RowResult(row(), [Sample(310.0, 20.0)], busy=2).granted == 0


def test_loaded_results_stand_beside_the_quiet_ones_and_broken_bounds_name_their_protection(tmp_path: Path) -> None:
    held, broken = RowResult(rows()[0], [Sample(100.0, 0.0)]), RowResult(rows()[0], [Sample(900.0, 0.0)], busy=2)
    for busy, one in ((0, held), (2, broken)):
        command.result_file(tmp_path, busy).write_text(json.dumps(result([one], {}, "go2", busy)))
    lines = markdown(command.read_tables([tmp_path])).splitlines()
    assert lines[0] == "| fault | judged | go2 | go2, 2 busy processes |"
    assert lines[2] == "| camera stops | zero | ≤ 500: 100 / 100 / 100, n 1 | ≤ 500: 900 / 900 / 900, n 1 **failed** |"
    assert lines[-2] == "Bounds that do not hold under load:"
    assert lines[-1].startswith("- camera stops (go2, 2 busy processes): p99.9 above 500 ms; protected by its control")


@pytest.mark.parametrize(
    ("fault", "judge", "protection"),
    [
        ("camera-stopped", None, "control thread"),
        ("runner-killed", None, "its service's"),
        (None, Judge.ROBOT, "own timer"),
    ],
)
def test_a_bound_is_protected_by_the_process_that_reacts(
    fault: str | None, judge: Judge | None, protection: str
) -> None:
    assert protection in RowResult(Row("test", fault, lambda rig: 0, judge=judge), []).protected_by


def test_the_load_is_so_many_processes_that_end_with_the_measurement() -> None:
    with busy_processes(2) as pids:
        commands = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids]
    assert len(set(pids)) == 2 and all(b"while True" in one for one in commands)
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_the_load_stands_still_while_a_run_starts() -> None:
    def states(pids: list[int]) -> set[str]:
        return {Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] for pid in pids}

    with busy_processes(2) as pids:
        with paused(pids):
            wait_for(lambda: states(pids) == {"T"}, 10.0, "busy processes to stand still")
        wait_for(lambda: states(pids) == {"R"}, 10.0, "busy processes to go on")


def test_a_number_of_injections_holds_for_slow_rows_too() -> None:
    slow = replace(row(), share=0.2)
    assert command.count(slow, None) == 1 and command.count(slow, 20) == 20


def test_every_fault_of_the_table_is_injected_or_says_why_not() -> None:
    injected = {one.fault for robot in ROBOTS.values() for one in rows(robot)}
    movable = {name for name, fault in FAULTS.items() if fault.where != "start"}
    assert movable - injected <= set(NOT_INJECTED)
    assert not {one.fault for one in rows()} & set(NOT_INJECTED)


def test_a_row_must_have_a_criterion_and_name_a_known_fault() -> None:
    with pytest.raises(ValueError, match="a judge"):
        Row("test", None, lambda rig: 0)
    with pytest.raises(ValueError, match="not in the fault table"):
        Row("test", "meteorite", lambda rig: 0)


@pytest.mark.parametrize("start", [SE2(0.0, 0.0, 0.0), SE2(1.0, 0.0, -math.pi / 2), SE2(-1.3, 0.5, 0.4)])
def test_the_plan_leads_onto_the_circle_and_stays_there(start: SE2) -> None:
    pose, radii = start, []
    for index in range(400):
        x, y, theta = (float(v) for v in circle.plan(pose, 30, 0.1, 0.7 * index)[9])
        speed, turn = arc_to(SE2(x, y, theta), 1.0)
        pose = pose @ SE2(speed * 0.1 * math.cos(turn * 0.05), speed * 0.1 * math.sin(turn * 0.05), turn * 0.1)
        radii.append(math.hypot(pose.x_m, pose.y_m))
    assert max(radii) < 1.6 and all(0.7 < radius < 1.3 for radius in radii[200:])


def test_the_plan_is_never_the_same_twice() -> None:
    pose = SE2(circle.RADIUS_M, 0.0, math.pi / 2)
    plans = {circle.plan(pose, 30, 0.1, 0.7 * index).tobytes() for index in range(20)}
    assert len(plans) == 20


def test_requests_are_distinguished_by_source_and_time(tmp_path: Path) -> None:
    lines = [{"t_ns": t, "source": s, "velocity": [0.1, 0, 0]} for t, s in ((1, 0), (2, 1), (3, 0))]
    (tmp_path / "received").write_text("".join(json.dumps(line) + "\n" for line in lines))
    received = ReceivedCommands(tmp_path / "received")
    assert received.sources() == {0, 1} and [one.t_ns for one in received.since(2)] == [2, 3]


@pytest.fixture
def switched(tmp_path: Path):
    switches = Switches(tmp_path / "s", ["one", "two"])
    with FaultClient(tmp_path / "s", tmp_path / "c") as client:
        yield switches, client


@pytest.mark.parametrize("after", [1, 3])
def test_a_fault_takes_effect_when_its_code_runs_for_the_given_time(switched, after: int) -> None:
    switches, client = switched
    client.ask("one", seconds_s=2.0, after=after)
    client.inject("two", on=False)  # answered at once, and after what was asked before: the first request has arrived
    with pytest.raises(FaultError, match="no effect"):
        client.effect_ns("one", 0.1)
    assert switches.hit("two") is None
    assert [switches.hit("one") for _ in range(after)] == [{"seconds_s": 2.0}] * after
    assert client.effect_ns("one", 1.0) > 0
    client.inject("one", on=False)
    assert switches.hit("one") is None


def test_an_unknown_fault_is_refused(switched) -> None:
    with pytest.raises(FaultError, match="refused"):
        switched[1].inject("three")


def test_without_a_runner_a_fault_cannot_be_asked_for(tmp_path: Path) -> None:
    with (
        FaultClient(tmp_path / "nobody", tmp_path / "c") as client,
        pytest.raises(FaultError, match="no process accepts"),
    ):
        client.inject("one")


@pytest.mark.parametrize(
    "arguments",
    [
        ["--rows", "rain", "--list"],
        ["--per-row", "0", "--list"],
        ["--load", "-1", "--list"],
        ["--artifacts", "nowhere"],
        [],
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main([*arguments, "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


class Hindered:
    """A rig whose injection is hindered, the first `times`; its runner takes `start_s` to start."""

    stand_in = False

    def __init__(
        self, times: int, monkeypatch: pytest.MonkeyPatch, start_s: float = 0.0, sample: Sample | None = None
    ) -> None:
        self.hindered = sample or Sample(100.0, 0.0, hindered=["did not drive on"])
        self.left, self.start_s, self.now_s, self.injected_s = times, start_s, 0.0, list[float]()
        monkeypatch.setattr(command, "injection", self.injection)
        clock = SimpleNamespace(monotonic_ns=lambda: round(self.now_s * 1e9), sleep=self.sleep)
        monkeypatch.setattr(command, "time", clock)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def ensure_moving(self) -> None:
        self.now_s, self.start_s = self.now_s + self.start_s, 0.0

    def injection(self, *_: object) -> Sample:
        self.injected_s.append(self.now_s)
        self.left -= 1
        return deepcopy(self.hindered) if self.left >= 0 else Sample(100.0, 0.0)


@pytest.mark.parametrize(("times", "repeated", "passes"), [(0, 0, True), (1, 1, True), (2, 1, False)])
def test_a_robot_that_does_not_drive_on_fails_a_row_only_twice_in_a_row(
    times: int, repeated: int, passes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Hindered(times, monkeypatch)
    result = command.run_row(rig, row(), 1, random.Random(0), None)  # type: ignore[arg-type]
    assert result.repeated == repeated and (not result.problems) == passes
    assert len(result.samples) == 1 + repeated


@pytest.mark.parametrize(
    ("stood", "wrong", "times", "passes"),
    [(True, [], 1, True), (True, [], 2, False), (True, ["moved"], 1, False), (False, [], 1, False)],
    ids=["stood once", "stood twice", "stood and moved after it", "no reaction and did not drive on"],
)
def test_only_a_fault_that_hit_a_robot_that_stood_is_left_out_and_only_once(
    stood: bool, wrong: list[str], times: int, passes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Hindered(times, monkeypatch, sample=Sample(None, 0.0, wrong, ["x"], stood=stood))
    result = command.run_row(rig, row(), 1, random.Random(0), None)  # type: ignore[arg-type]
    assert (not result.problems) == passes and result.repeated == 1


@pytest.mark.parametrize(("stood_ms", "judged"), [(None, True), (-0.001, False), (-500, False)])
def test_an_injection_is_judged_only_if_the_robot_moved_before_it(
    stood_ms: float | None, judged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    obeys, effects = [(-10_000 * MS, True)], list[int]()
    rig = SimpleNamespace(
        robot_obeys_motion=lambda: obeys,
        received=SimpleNamespace(since=lambda _: [], sources=frozenset),
    )

    def inject(_: object) -> int:
        effects.append(time.monotonic_ns())
        obeys.append((effects[0] + round((5 if stood_ms is None else stood_ms) * MS), False))
        return effects[0]

    monkeypatch.setattr(measure, "_aftermath", lambda *_: None)
    one = Row("test", None, inject, judge=Judge.ROBOT, bound=10.0)
    sample = measure.injection(rig, one, random.Random(0), SimpleNamespace(between_ns=lambda *_: 0))  # type: ignore[arg-type]
    assert (sample.latency_ms == 5.0) == judged and (sample.hindered == []) == judged and sample.stood != judged


def test_the_pause_of_a_row_is_between_two_injections_however_long_the_runner_takes_to_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Hindered(0, monkeypatch, start_s=6.0)
    command.run_row(rig, replace(row(), spacing_s=12.5), 2, random.Random(0), None)  # type: ignore[arg-type]
    assert rig.injected_s == [6.0, 18.5]


class FakeBridge:
    """A bridge that needs an operator, arms in the third step and stops the robot in the sixth."""

    def __init__(self, _path: Path) -> None:
        self.polls, self.arms = 0, 0
        self.velocities: list[tuple[float, float]] = []

    def poll(self) -> SimpleNamespace:
        self.polls += 1
        state = "disarmed" if self.polls < 3 else "armed" if self.polls < 6 else "stopped"
        return SimpleNamespace(state=state, reason="bus-off", permit="needed")

    def arm(self) -> None:
        self.arms += 1

    def send_velocity(self, _seq: int, _stamp_ns: int, vx_mps: float, _vy_mps: float, wz_radps: float) -> None:
        self.velocities.append((vx_mps, wz_radps))


@pytest.mark.parametrize(("age_s", "drives"), [(0.0, True), (0.6, False)])
def test_the_runners_stand_in_drives_from_a_fresh_pose_once_armed_until_the_bridge_stops_it(
    age_s: float, drives: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bridge = FakeBridge(Path())
    state = SimpleNamespace(received_ns=time.monotonic_ns() - round(age_s * 1e9), T_odom_base=(1.0, 0.0, math.pi / 2))
    monkeypatch.setattr(driver, "BridgeClient", lambda _path: bridge)
    monkeypatch.setattr(driver, "_reader", lambda _config: SimpleNamespace(state=lambda: state))
    monkeypatch.setattr(driver, "_PERIOD_NS", 1_000_000)
    config = SimpleNamespace(bridge=SimpleNamespace(socket="bridge"))
    assert driver.drive(config) == "bus-off"  # type: ignore[arg-type]
    assert bridge.arms == 1 and capsys.readouterr().err == "driver: waiting for `edge-bridge arm`\n"
    assert bridge.velocities[:2] == [(0.0, 0.0)] * 2 and len(bridge.velocities) == 5
    assert all((vx > 0.5 and wz > 0.3) == drives for vx, wz in bridge.velocities[2:])
