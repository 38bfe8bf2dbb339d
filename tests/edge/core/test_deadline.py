"""One deadline for all waits of an end."""

from __future__ import annotations

import threading

import pytest

from edge.core.deadline import Deadline

S = 1_000_000_000


def test_the_remaining_time_shrinks_and_never_goes_below_zero() -> None:
    now_ns = [0]
    deadline = Deadline(7.0, clock=lambda: now_ns[0])
    now_ns[0] = 5 * S
    assert (deadline.left_s(), deadline.left_s(1.0)) == (2.0, 1.0)
    now_ns[0] = 9 * S
    assert (deadline.left_s(), deadline.left_s(1.0)) == (0.0, 0.0)


def test_a_hanging_call_is_left_behind() -> None:
    go_on = threading.Event()
    assert not Deadline(0.05).run("hangs", lambda: go_on.wait(30))
    go_on.set()


def test_a_call_that_ends_in_time_is_awaited_and_its_error_raised() -> None:
    done: list[int] = []
    assert Deadline(30.0).run("ends", lambda: done.append(1)) and done == [1]
    with pytest.raises(ZeroDivisionError):
        Deadline(30.0).run("fails", lambda: 1 // 0)
