"""The fuzz harness: what it finds, and a short run on every decoder."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.step_types import Report, Request
from sim_hil.realtime.robots import ROBOT_FILES
from tests.support.robot.bridge_bench import STILL
from tools.fuzz import __main__ as command
from tools.fuzz.harness import FuzzError, fuzz, mutated


class FakeTarget:
    """A backend that gives the same report in every step, and a wire on which `sent` was sent."""

    batch = 1

    def __init__(self, report: Report | None = None, sent: str | None = None, error: Exception | None = None) -> None:
        self.config: RobotConfig = load_robot_config(ROBOT_FILES / "carter_can_sim.toml")
        self.link, self.decoded = self, 0
        self._report, self._sent, self._error = report or Report(), sent, error

    def now_ns(self) -> int:
        return 1_000_000_000 + 20_000_000 * self.decoded

    def put(self, chance: random.Random) -> None:
        self.decoded += 1

    def read(self, now_ns: int) -> Report:
        if self._error is not None:
            raise self._error
        return self._report

    def write(self, request: Request) -> None:
        pass

    def dropped(self) -> tuple[int, int, int]:
        return 0, 0, 0

    def motion(self) -> str | None:
        return self._sent

    def close(self) -> None:
        pass


def run(target: FakeTarget) -> None:
    fuzz("can", target, 10, 0, lambda line: None)


def test_a_backend_that_does_nothing_passes() -> None:
    run(FakeTarget())


def test_a_sent_motion_is_found() -> None:
    with pytest.raises(FuzzError, match="VelocityCommand"):
        run(FakeTarget(sent="VelocityCommand 01"))


def test_a_state_that_cannot_be_true_is_found() -> None:
    with pytest.raises(FuzzError, match="let through"):
        run(FakeTarget(Report(state=replace(STILL, vx_mps=float("nan")))))


def test_an_exception_is_found_and_its_input_named() -> None:
    lines: list[str] = []
    with pytest.raises(KeyError):
        fuzz("can", FakeTarget(error=KeyError("x")), 10, 7, lines.append)
    assert lines == ["failed within 1 inputs after input 0, seed 7"]


def test_the_same_seed_makes_the_same_inputs() -> None:
    one, other = random.Random(3), random.Random(3)
    assert [mutated(b"abcdef", one) for _ in range(50)] == [mutated(b"abcdef", other) for _ in range(50)]


@pytest.mark.slow
@pytest.mark.parametrize("decoder", sorted(command.ROBOTS))
def test_nothing_is_found_in_many_inputs(decoder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--decoder", decoder, "--inputs", "50000", "--seed", "2"]) == 0
    assert f'"decoder": "{decoder}"' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--decoder", "can", "--inputs", "0"], "fuzz: --inputs: expected 1 or more, found 0"),
        (["--decoder", "can", "--robot", str(ROBOT_FILES / "go2_sim.toml")], "expected protocol can, found unitree"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    arguments: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1
