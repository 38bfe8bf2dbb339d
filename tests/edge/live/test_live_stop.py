"""The view's STOP: the operator's stop and the runner's, of which either may fail, hang or come late."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from edge.live import stop as stop_module
from edge.live import wire
from edge.live.stop import RobotStop

Operate = Callable[..., tuple[int, dict[str, object]]]


class Desk:
    """A STOP button, the operator's stop behind it, and a runner with a set answer to, or nothing."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.confirms: bool | None = None
        self.requested_s: list[float] = []
        self._patch = patch

    def operator(self, operate: Operate) -> None:
        self._patch.setattr(stop_module, "operate", operate)

    def run(self, body: Callable[[RobotStop], Awaitable[Any]], bridge: Path = Path("b.sock")) -> Any:
        async def with_runner() -> Any:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with ours, theirs:
                for end in (ours, theirs):
                    end.setblocking(False)
                stop = RobotStop(bridge, ours)
                runner = asyncio.create_task(self._answer(stop, theirs))
                try:
                    return await body(stop)
                finally:
                    runner.cancel()
                    with contextlib.suppress(asyncio.CancelledError):
                        await runner

        return asyncio.run(with_runner())

    async def _answer(self, stop: RobotStop, end: socket.socket) -> None:
        while data := await asyncio.get_running_loop().sock_recv(end, wire.MOST_BYTES):
            assert wire.decode(data).kind == wire.STOP
            self.requested_s.append(time.monotonic())
            if self.confirms is not None:
                stop.answered(self.confirms)


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    monkeypatch.setattr(stop_module, "ANSWER_S", 0.5)
    return Desk(monkeypatch)


class Hanging:
    """An operator's stop that does not return before `release` is set."""

    def __init__(self) -> None:
        self.release = threading.Event()

    def __call__(self, *_: object, **__: object) -> tuple[int, dict[str, object]]:
        self.release.wait(5.0)
        return 0, {}


async def press(stop: RobotStop) -> dict[str, Any]:
    return await stop.stop()


def test_an_operators_stop_that_is_soon_confirmed_leaves_the_runner_alone(desk: Desk) -> None:
    desk.operator(lambda *_, **__: (0, {}))
    answer = desk.run(press)
    assert answer["stopped"] and answer["latched"] and desk.requested_s == []


def test_the_runner_stops_the_robot_where_the_operators_stop_fails(desk: Desk) -> None:
    def operate(*_: object, **__: object) -> tuple[int, dict[str, object]]:
        raise OSError(errno.EMFILE, "Too many open files")

    desk.operator(operate)
    desk.confirms = True
    answer = desk.run(press)
    assert answer["stopped"] and not answer["latched"] and len(desk.requested_s) == 1


def test_the_runner_stops_the_robot_while_the_operators_stop_hangs(desk: Desk) -> None:
    hanging = Hanging()
    desk.operator(hanging)
    desk.confirms = True

    async def body(stop: RobotStop) -> tuple[dict[str, Any], float]:
        pressed_s = time.monotonic()
        try:
            return await stop.stop(), pressed_s
        finally:
            hanging.release.set()

    answer, pressed_s = desk.run(body)
    assert answer["stopped"] and not answer["latched"]
    assert 0.4 < desk.requested_s[0] - pressed_s < 2.0


def test_a_late_confirmation_of_the_operators_stop_counts(desk: Desk) -> None:
    def operate(*_: object, **__: object) -> tuple[int, dict[str, object]]:
        time.sleep(0.7)
        return 0, {}

    desk.operator(operate)
    answer = desk.run(press)
    assert answer["stopped"] and answer["latched"] and len(desk.requested_s) == 1


STOPPED_AND_MOVING: dict[str, object] = {"state": "stopped", "blocked_by": "estop", "motion": "moving"}
"""Status of a bridge that an operator has stopped and whose robot does not stand yet."""


@pytest.mark.parametrize(
    ("operators", "latched", "said"),
    [
        ((1, STOPPED_AND_MOVING), True, "Before it moves again: edge-bridge arm"),
        ((1, {"error": "not confirmed"}), False, "It is unknown whether the operator's stop is in effect"),
        ((1, {**STOPPED_AND_MOVING, "blocked_by": "none"}), False, "a new run may arm"),
        ((3, {"error": "no bridge"}), False, "No operator's stop was possible: a new run can arm"),
    ],
    ids=["in effect", "no status", "not in effect", "no bridge"],
)
def test_the_runners_confirmation_says_whether_the_operators_stop_is_in_effect(
    desk: Desk, operators: tuple[int, dict[str, object]], latched: bool, said: str
) -> None:
    """A robot that comes to rest after the operator's 2 s: the stop is in effect, and only the runner confirms it."""
    desk.operator(lambda *_, **__: operators)
    desk.confirms = True
    answer = desk.run(press)
    assert answer["stopped"] and answer["latched"] is latched and said in answer["text"]
    assert latched or "edge-bridge arm" not in answer["text"]


def test_a_stop_in_effect_of_a_robot_that_still_moves_is_not_confirmed(desk: Desk) -> None:
    desk.operator(lambda *_, **__: (1, STOPPED_AND_MOVING))
    desk.confirms = False
    answer = desk.run(press)
    assert not answer["stopped"] and answer["latched"] and "remote" in answer["text"]


def test_without_any_confirmation_it_says_so(desk: Desk) -> None:
    desk.operator(lambda *_, **__: (3, {}))
    desk.confirms = False
    answer = desk.run(press)
    assert not answer["stopped"] and "remote" in answer["text"]


def test_a_request_without_an_answer_does_not_keep_the_next_press_from_the_runner(desk: Desk) -> None:
    desk.operator(lambda *_, **__: (3, {}))

    async def body(stop: RobotStop) -> list[bool]:
        first = await stop.stop()
        desk.confirms = True
        second = await stop.stop()
        return [first["stopped"], second["stopped"]]

    assert desk.run(body) == [False, True]
    assert len(desk.requested_s) == 2


def test_a_stop_under_way_is_answered_when_the_runner_has_ended(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_module, "ANSWER_S", 30.0)
    desk.operator(lambda *_, **__: (3, {}))

    async def body(stop: RobotStop) -> dict[str, Any]:
        pressed = asyncio.create_task(stop.stop())
        while not desk.requested_s:
            await asyncio.sleep(0.01)
        await stop.finish()
        assert pressed.done() or (await asyncio.wait({pressed}, timeout=1.0))[0]
        return pressed.result()

    assert not desk.run(body)["stopped"]


def test_it_writes_nothing_to_a_terminal_that_could_block_or_be_gone(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []

    class Gone:
        def write(self, text: str) -> int:
            written.append(text)
            raise OSError(errno.EIO, "the terminal is gone")

        def flush(self) -> None:
            raise OSError(errno.EIO, "the terminal is gone")

    desk.confirms = True
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", Gone())
        answer = desk.run(press, tmp_path / "no-bridge.sock")
    assert answer["stopped"] and written == []
