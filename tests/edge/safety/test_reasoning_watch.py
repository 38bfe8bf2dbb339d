"""A reasoning thread that hangs in a call: interrupted, then given up; slow ones and frozen processes are neither."""

from __future__ import annotations

from edge.safety.reasoning_watch import Hang, ReasoningWatch

S = 1_000_000_000
LOOK_NS = S // 20


class Run:
    """A watch and a reasoning thread that makes progress when the test says so."""

    def __init__(self, longest_ms: float | None = None) -> None:
        self.watch = ReasoningWatch()
        self.longest_ms = longest_ms
        self.now_ns = self.progress_ns = 100 * S
        self.said: list[tuple[float, Hang]] = []

    def hang(self, seconds: float) -> Run:
        """The thread is in one call for so long, looked at 20 times a second."""
        for _ in range(round(seconds * S / LOOK_NS)):
            self.now_ns += LOOK_NS
            hang = self.watch.step(self.progress_ns, self.longest_ms, self.now_ns)
            if hang is not Hang.NONE:
                self.said.append((round((self.now_ns - self.progress_ns) / S), hang))
        return self

    def goes_on(self) -> None:
        self.progress_ns = self.now_ns


def test_a_call_that_takes_ten_seconds_is_interrupted_once() -> None:
    assert Run().hang(25).said == [(10, Hang.INTERRUPT)]


def test_a_call_that_an_interrupt_does_not_end_is_given_up() -> None:
    said = Run().hang(31).said
    assert said[:2] == [(10, Hang.INTERRUPT), (30, Hang.GIVE_UP)]


def test_after_an_interrupt_that_helped_the_next_hang_is_interrupted_again() -> None:
    run = Run().hang(12)
    run.goes_on()
    run.hang(12)
    assert [hang for _, hang in run.said] == [Hang.INTERRUPT, Hang.INTERRUPT]


def test_calls_that_end_are_left_alone_however_many_there_are() -> None:
    run = Run()
    for _ in range(20):
        run.hang(9)
        run.goes_on()
    assert run.said == []


def test_where_generations_take_long_a_call_may_too() -> None:
    assert Run(longest_ms=8_000).hang(23).said == []
    assert Run(longest_ms=8_000).hang(25).said == [(24, Hang.INTERRUPT)]


def test_a_process_that_was_frozen_has_not_hung() -> None:
    run = Run().hang(1)
    run.now_ns += 3600 * S
    assert run.hang(1).said == []
