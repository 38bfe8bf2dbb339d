"""Rows 8 to 12 of the fault matrix: which reports of the robot are believed."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from edge.odometry.gate import OdometryGate, OdometryInputs, Verdict

STEP_NS = 20_000_000


def report(index: int, x: float = 0.0, theta: float = 0.0, **fields: object) -> OdometryInputs:
    base = OdometryInputs((index + 1) * STEP_NS, (x, 0.0, theta), 0.0, 0.0, 0.0)
    return replace(base, **fields)  # type: ignore[arg-type]


def names(verdict: Verdict) -> list[str]:
    return [finding.name for finding in verdict.findings]


def feed(reports: list[OdometryInputs]) -> list[Verdict]:
    gate = OdometryGate()
    return [gate.step(one) for one in reports]


def walking(count: int, speed: float = 0.5) -> list[OdometryInputs]:
    return [report(i, x=speed * i * 0.02, vx_mps=speed) for i in range(count)]


def test_a_robot_that_walks_is_believed() -> None:
    verdicts = feed(walking(100))
    assert all(not v.findings for v in verdicts)
    assert sum(v.increment.dx_m for v in verdicts if v.increment) == pytest.approx(99 * 0.01)


@pytest.mark.parametrize(("x", "theta"), [(1.0, 0.0), (0.0, math.pi / 2)], ids=["1 m", "90 degrees"])
def test_a_jump_is_rejected_at_once(x: float, theta: float) -> None:
    verdicts = feed([report(0), report(1), report(2, x=x, theta=theta)])
    assert verdicts[2].increment is None
    assert names(verdicts[2]) == ["odometry-jump"]


def test_a_pose_that_jumps_and_comes_back_is_one_jump() -> None:
    verdicts = feed([*walking(10), report(10, x=5.0), *[report(i, x=0.01 * i, vx_mps=0.5) for i in range(11, 20)]])
    assert [names(v) for v in verdicts].count(["odometry-jump"]) == 1
    assert sum(v.increment.dx_m for v in verdicts if v.increment) == pytest.approx(0.19)


def test_a_pose_that_jumps_and_stays_is_one_jump_and_no_motion() -> None:
    verdicts = feed([*walking(10), *[report(i, x=5.0 + 0.01 * i, vx_mps=0.5) for i in range(10, 30)]])
    assert [names(v) for v in verdicts].count(["odometry-jump"]) == 1
    # The step over which it jumped is bridged by the reported velocity.
    assert sum(v.increment.dx_m for v in verdicts if v.increment) == pytest.approx(0.29, abs=1e-6)


@pytest.mark.parametrize(
    "fields",
    [
        {"T_odom_base": (math.nan, 0.0, 0.0)},
        {"T_odom_base": (0.0, 0.0, math.inf)},
        {"vx_mps": math.nan},
        {"gyro_wz_radps": math.inf},
        {"pitch_rad": math.nan},
    ],
    ids=str,
)
def test_an_invalid_pose_is_rejected(fields: dict[str, object]) -> None:
    verdicts = feed([report(0), report(1), replace(report(2), **fields), report(3)])  # type: ignore[arg-type]
    assert names(verdicts[2]) == ["odometry-not-finite"]
    assert verdicts[2].increment is None
    assert verdicts[3].increment is not None


def test_a_report_that_is_not_newer_is_no_motion() -> None:
    verdicts = feed([report(0), report(5, x=0.05), report(5, x=0.5), report(3, x=0.7)])
    assert [v.increment is None for v in verdicts] == [True, False, True, True]


def test_a_constant_pose_under_a_walk_command_is_frozen_after_half_a_second() -> None:
    verdicts = feed([report(i, commanded=(0.3, 0.0, 0.0)) for i in range(40)])
    first = next(i for i, v in enumerate(verdicts) if "odometry-frozen" in names(v))
    assert first * 0.02 == pytest.approx(0.5, abs=0.021)


@pytest.mark.parametrize(
    ("moved_m", "pause_s", "name"),
    [
        (0.3, 2.0, "robot-blocked"),
        (0.3, 13.0, "robot-blocked"),
        (0.3, 16.0, "odometry-frozen"),
        (0.0, 2.0, "odometry-stays-frozen"),
        (0.0, 12.0, "odometry-frozen"),
    ],
    ids=["moved", "moved slowly", "moved long ago", "stayed", "stayed long ago"],
)
def test_a_pose_that_stays_again_is_frozen_or_blocked_by_whether_it_moved_meanwhile(
    moved_m: float, pause_s: float, name: str
) -> None:
    pushes, pause = (0.3, 0.0, 0.0), round(pause_s / 0.02)
    reports = [report(i, commanded=pushes) for i in range(30)]
    reports += [report(30 + i, x=-moved_m * i / pause, commanded=(0.0, 0.0, 0.0)) for i in range(pause)]
    reports += [report(30 + pause + i, x=-moved_m, commanded=pushes) for i in range(30)]
    found = [name for verdict in feed(reports) for name in names(verdict)]
    assert found == ["odometry-frozen", name]


def test_a_jump_between_two_poses_that_stay_frees_no_robot() -> None:
    pushes = (0.3, 0.0, 0.0)
    reports = [report(i, x=0.0 if i < 40 else 1.0, commanded=pushes) for i in range(90)]
    found = [name for verdict in feed(reports) for name in names(verdict)]
    assert found == ["odometry-frozen", "odometry-jump", "odometry-stays-frozen"]


@pytest.mark.parametrize("command", [(0.15, 0.0, 0.0), (0.0, 0.0, 0.8), None])
def test_a_pose_that_stays_without_a_command_to_walk_is_not_frozen(command: tuple[float, float, float] | None) -> None:
    assert all(not v.findings for v in feed([report(i, commanded=command) for i in range(100)]))


def test_two_speeds_that_disagree_by_more_than_half_a_metre_a_second_are_found_within_300_ms() -> None:
    bad = [report(i, x=0.01 * i, vx_mps=0.5 + (0.8 if i >= 20 else 0.0)) for i in range(60)]
    verdicts = feed(bad)
    first = next(i for i, v in enumerate(verdicts) if "odometry-speed-mismatch" in names(v))
    assert 20 < first <= 20 + 15


def test_two_speeds_that_disagree_a_little_do_not_matter() -> None:
    verdicts = feed([report(i, x=0.01 * i, vx_mps=0.9) for i in range(100)])
    assert all(not v.findings for v in verdicts)


def test_reports_that_come_in_a_burst_have_the_speed_of_the_robots_clock() -> None:
    reports = [
        replace(r, robot_stamp_ns=r.received_ns, received_ns=(r.received_ns // 100_000_000 + 1) * 100_000_000 + i)
        for i, r in enumerate(walking(100))
    ]
    assert all("odometry-speed-mismatch" not in names(v) for v in feed(reports))


@pytest.mark.parametrize("ahead_s", [2, 3600])
def test_a_robots_clock_that_is_set_back_is_not_lag(ahead_s: int) -> None:
    ahead = [replace(r, robot_stamp_ns=r.received_ns + ahead_s * 10**9) for r in walking(50)]
    back = [replace(r, robot_stamp_ns=r.received_ns) for r in walking(60)[50:]]
    verdicts = feed([*ahead, *back])
    assert all(not v.findings for v in verdicts)
    assert all(v.increment is not None for v in verdicts[1:])


def delayed(index: int, delay_ms: int) -> OdometryInputs:
    """A report of a robot that stands, with its clock's stamp, `delay_ms` later than it could come."""
    stamp_ns = (index + 1) * STEP_NS
    return report(index, robot_stamp_ns=stamp_ns + 10**9, received_ns=stamp_ns + delay_ms * 1_000_000)


def test_reports_whose_delay_grows_to_ten_seconds_are_stale_all_the_time() -> None:
    """On a congested link, 10 ms a report."""
    verdicts = feed([delayed(i, 10 * i) for i in range(1000)])
    assert all(names(v) == ["odometry-stale"] for v in verdicts[26:])


def test_reports_that_are_still_late_after_a_delay_has_shrunk_are_stale() -> None:
    verdicts = feed([*[delayed(i, 10 * i) for i in range(1000)], *[delayed(i, 3000) for i in range(1400, 1450)]])
    assert all(names(v) == ["odometry-stale"] for v in verdicts[1000:])


def test_a_robots_clock_that_is_set_back_during_a_silence_is_not_lag() -> None:
    """The robot restarts for 10 s, and its clock goes on 2 s after its last stamp."""
    verdicts = feed([*[delayed(i, 0) for i in range(50)], *[delayed(i, 8000) for i in range(150, 200)]])
    assert all(not v.findings for v in verdicts)


@pytest.mark.parametrize("ppm", [-450, 450])
def test_a_robots_clock_that_runs_a_little_fast_or_slow_is_no_delay(ppm: int) -> None:
    reports = [
        report(i, robot_stamp_ns=round((i + 1) * STEP_NS * (1 + ppm * 1e-6)) + 10**9) for i in range(0, 200000, 40)
    ]
    assert all(not v.findings for v in feed(reports))


def turning(count: int, yaw_radps: float, gyro_radps: float) -> list[OdometryInputs]:
    return [report(i, theta=yaw_radps * i * 0.02, wz_radps=yaw_radps, gyro_wz_radps=gyro_radps) for i in range(count)]


@pytest.mark.parametrize(("yaw", "gyro"), [(1.0, 0.0), (-1.0, 0.0), (0.1, 1.2)])
def test_a_gyro_that_disagrees_with_the_reported_yaw_is_found_within_300_ms_and_not_followed(
    yaw: float, gyro: float
) -> None:
    verdicts = feed(turning(60, yaw, gyro))
    first = next(i for i, v in enumerate(verdicts) if "odometry-speed-mismatch" in names(v))
    assert first <= 15
    assert all(v.increment is not None and v.increment.turn_rad == v.increment.odometry_rad for v in verdicts[first:])


def test_a_gyro_that_is_a_little_off_is_followed() -> None:
    verdicts = feed(turning(60, 1.0, 0.7))
    assert all(not v.findings for v in verdicts)
    assert verdicts[-1].increment is not None and verdicts[-1].increment.turn_rad == pytest.approx(0.7 * 0.02)


def test_a_gyro_is_not_judged_by_its_ends_of_a_long_silence() -> None:
    before, after = turning(20, 1.0, 1.0), [report(i, theta=0.4, gyro_wz_radps=0.0) for i in range(100, 140)]
    assert all("odometry-speed-mismatch" not in names(v) for v in feed([*before, *after]))


def test_a_robot_that_was_stopped_in_a_silence_has_no_two_speeds() -> None:
    """0.65 s without a report, of which it drove a small part; the next one still says the speed it had."""
    silent = 32
    before = walking(50, speed=0.8)
    after = [report(49 + silent + i, x=0.784 + 0.08 + 0.016 * i, vx_mps=0.8) for i in range(30)]
    assert not any("odometry-speed-mismatch" in names(verdict) for verdict in feed([*before, *after]))
