"""What a long build is doing: stage, elapsed time, time to go and memory, on standard error only."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.spinner import Spinner
from rich.text import Text

_REDRAWS_PER_S = 4
_PLAIN_PERIOD_S = 15.0
_RATE_LIMITS = (0.05, 20.0)


@dataclass(frozen=True)
class Stage:
    """One step of a build and the seconds expected for it (of an earlier run, or a guess that is data)."""

    name: str
    expected_s: float


def peak_rss_bytes() -> int:
    """Largest memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def duration(seconds: float) -> str:
    """`8 s`, `2 min 05 s`, `1 h 02 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class StageWatch:
    """Handle of the stage that runs; `from_cache` tells that it did no work."""

    def __init__(self) -> None:
        self.cached = False

    def from_cache(self) -> None:
        """The stage's result was there already: its time says nothing about the speed of this machine."""
        self.cached = True


class Progress:
    """Stage i of n with elapsed time, time to go and peak memory; a live line on a terminal, else plain lines.

    Used as a context manager around the whole build, with `stage` around each step in the order they were announced.
    """

    def __init__(self, command: str, stages: Sequence[Stage], stream: TextIO | None = None) -> None:
        self._command = command
        self._stages = list(stages)
        self._console = Console(file=stream if stream is not None else sys.stderr, highlight=False, soft_wrap=True)
        self._live: Live | None = None
        self._started_ns = self._stage_ns = time.monotonic_ns()
        self._index = -1
        self._detail = ""
        self._said_ns = 0
        self._built_s: dict[str, float] = {}

    def __enter__(self) -> Progress:
        self._started_ns = self._stage_ns = time.monotonic_ns()
        if self._console.is_terminal:
            spinner = Spinner("dots")
            self._live = Live(
                console=self._console,
                get_renderable=lambda: spinner if self._index < 0 else self._renderable(spinner),
                refresh_per_second=_REDRAWS_PER_S,
                transient=True,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    @property
    def built_s(self) -> dict[str, float]:
        """Seconds of every finished stage that did work."""
        return dict(self._built_s)

    def say(self, line: str) -> None:
        """One line of its own, above the live one."""
        self._console.print(f"{self._command}: {escape(line)}")

    def detail(self, text: str) -> None:
        """What the stage is at: part of the live line, else a line of its own now and then."""
        self._detail = text
        now_ns = time.monotonic_ns()
        if self._live is None and (now_ns - self._said_ns) / 1e9 >= _PLAIN_PERIOD_S:
            self._said_ns = now_ns
            self.say(self.line())

    @contextmanager
    def stage(self, name: str) -> Iterator[StageWatch]:
        """Around one stage; stages that were announced before it and never began count as done."""
        names = [stage.name for stage in self._stages]
        self._index = names.index(name)
        self._stage_ns = self._said_ns = time.monotonic_ns()
        self._detail = ""
        watch = StageWatch()
        if self._live is None:
            self.say(self.line())
        yield watch
        took_s = (time.monotonic_ns() - self._stage_ns) / 1e9
        if not watch.cached:
            self._built_s[name] = took_s
        self.say(
            f"[{self._index + 1}/{len(names)}] {name}: {'from the cache' if watch.cached else 'done'}, {took_s:.1f} s"
        )

    def remaining_s(self) -> float:
        """Expected seconds to the end: what is left by expectation, at the speed that the finished stages had."""
        if self._index < 0:
            return sum(stage.expected_s for stage in self._stages)
        now = self._stages[self._index]
        expected = {stage.name: stage.expected_s for stage in self._stages}
        planned = sum(expected[name] for name in self._built_s)
        low, high = _RATE_LIMITS
        rate = min(max(sum(self._built_s.values()) / planned, low), high) if planned > 0 else 1.0
        spent_s = (time.monotonic_ns() - self._stage_ns) / 1e9
        later = sum(stage.expected_s for stage in self._stages[self._index + 1 :])
        return max(now.expected_s * rate - spent_s, 0.0) + later * rate

    def line(self) -> str:
        """The line that is shown now."""
        elapsed_s = (time.monotonic_ns() - self._started_ns) / 1e9
        return (
            f"[{self._index + 1}/{len(self._stages)}] {self._stages[self._index].name} · "
            f"{duration(elapsed_s)} so far, {duration(self.remaining_s())} to go · "
            f"peak {peak_rss_bytes() / 1e9:.1f} GB{' · ' if self._detail else ''}{self._detail}"
        )

    def _renderable(self, spinner: Spinner) -> Spinner:
        spinner.update(text=Text(self.line(), overflow="ellipsis", no_wrap=True))
        return spinner
