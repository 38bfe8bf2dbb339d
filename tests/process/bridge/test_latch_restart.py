"""The emergency-stop latch of the real `edge-bridge` process across its own death and a useless disk."""

from __future__ import annotations

import contextlib
import time
from itertools import pairwise
from pathlib import Path

import pytest

from tests.process.bridge.stop_rig import L2, REPETITIONS, B, Rig
from tests.support.processes import HostStall, Running, check_stop_latency, wait_for
from tests.support.robot.fake_go2 import FakeGo2

pytestmark = pytest.mark.process


@pytest.fixture
def rig(robot: FakeGo2, dds_domain: int, tmp_path: Path) -> Rig:
    rig = Rig(robot, dds_domain, tmp_path)
    rig.reset()
    return rig


def kill(bridge: Running) -> None:
    bridge.process.kill()
    bridge.process.wait()


def press_stop_keys(rig: Rig) -> None:
    rig.robot.remote = (0.0, 0.0, 0.0, 0.0, L2)
    time.sleep(0.1)
    rig.robot.remote = (0.0, 0.0, 0.0, 0.0, L2 | B)
    wait_for(lambda: rig.operate("status")[1]["blocked_by"] == "estop", 2, "the latch")
    rig.robot.remote = (0.0, 0.0, 0.0, 0.0, 0)


def is_not_driven_until_an_operator_arms(rig: Rig, wait_s: float = 0.7) -> None:
    since_ns = time.monotonic_ns()
    with rig.driver() as runner:
        time.sleep(wait_s)
        assert not rig.moved_since(since_ns)
        assert rig.operate("status")[1]["blocked_by"] == "estop"
        rig.arm_for(runner)
        wait_for(lambda: rig.robot.speed_mps > 0.3, 10, "the runner that an operator has armed")


@REPETITIONS
def test_a_killed_bridges_successor_drives_no_runner_until_an_operator_arms(rig: Rig, repetitions: int) -> None:
    with contextlib.ExitStack() as bridges:
        bridge = bridges.enter_context(rig.bridge())
        for number in range(repetitions):
            with rig.driving():
                if number % 2:
                    press_stop_keys(rig)
                else:
                    assert rig.operate("stop")[0] == 0
                kill(bridge)
            assert rig.latch.exists(), f"the latch was not kept in repetition {number}"
            wait_for(lambda: rig.robot.speed_mps < 0.05, 5, "a robot at rest")
            bridge = bridges.enter_context(rig.bridge(f"bridge {number}"))
            rig.reset()
            time.sleep(1.1 if number % 2 else 0.1)
            is_not_driven_until_an_operator_arms(rig)
            wait_for(lambda: not rig.latch.exists(), 2, "the latch file's end")
        assert repetitions == number + 1


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"", b"\xff\x00garbage", None], ids=["empty", "garbage", "a folder"])
def test_an_unreadable_latch_file_is_a_latch(rig: Rig, content: bytes | None) -> None:
    if content is None:
        rig.latch.mkdir()
    else:
        rig.latch.write_bytes(content)
    with rig.bridge():
        is_not_driven_until_an_operator_arms(rig)


@pytest.mark.slow
def test_a_latch_file_that_cannot_be_written_delays_nothing_and_is_reported_in_one_line(rig: Rig) -> None:
    folder = rig.folder / "removed later"
    folder.mkdir()
    with rig.bridge("bridge", "--latch", folder / "latch") as bridge, HostStall() as host:
        folder.rmdir()
        with rig.driving():
            since_ns = time.monotonic_ns()
            assert rig.operate("stop")[0] == 0
            time.sleep(0.5)
        times_ns = [one.received_ns for one in rig.robot.moves() if one.received_ns > since_ns]
        assert len(times_ns) > 20
        for earlier_ns, later_ns in pairwise(times_ns):
            check_stop_latency(later_ns - earlier_ns, 60_000_000, earlier_ns, host)
        is_not_driven_until_an_operator_arms(rig)
        said = [line for line in bridge.stderr().splitlines() if "latch file" in line]
    assert len(said) == 1 and "cannot be written" in said[0] and "may not survive a restart" in said[0]
