"""Progress of a command on standard error: a redrawn line or bar on a terminal, else a line from time to time."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO, TypeVar

from rich import progress as rich
from rich.console import Console
from rich.text import Text

_REDRAWS_PER_S = 4
_RATE_LIMITS = (0.05, 20.0)


def peak_rss_bytes() -> int:
    """Return the largest memory that this process has held so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def duration(seconds: float) -> str:
    """Format a duration: `8 s`, `2 min 05 s`, `1 h 02 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


_P = TypeVar("_P", bound="Progress")


class Progress:
    """Progress display, used as a context manager around the work.

    `prefix` begins every line. `describe` returns the status, which a terminal shows at every redraw; without it the
    status is the last one given to `show`. Elsewhere than on a terminal a status is a line, at most one per `period_s`
    (None: no status lines). With `bar` the terminal shows a bar of the counts given to `show`.
    """

    def __init__(
        self,
        prefix: str,
        describe: Callable[[], str] | None = None,
        *,
        bar: bool = False,
        period_s: float | None = 15.0,
        stream: TextIO | None = None,
    ) -> None:
        self._prefix, self._period_s = prefix, period_s
        self._status = ""
        self._done = self._total = self._first = 0
        self._describe = describe if describe is not None else lambda: self._status
        self._since_ns = time.monotonic_ns()
        self._printed_ns = self._since_ns if bar else None
        # Without a stream, rich looks up sys.stderr at every print.
        self._console = Console(file=stream, stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
        self._live: rich.Progress | None = None
        if self._console.is_terminal:
            columns: tuple[rich.ProgressColumn, ...] = (rich.SpinnerColumn(),)
            if bar:
                times = (rich.TimeElapsedColumn(), rich.TimeRemainingColumn())
                columns = (rich.BarColumn(bar_width=24), rich.MofNCompleteColumn(), *times)
            self._live = rich.Progress(
                *columns, _StatusColumn(lambda: prefix + self._describe()), console=self._console,
                refresh_per_second=_REDRAWS_PER_S, transient=not bar, redirect_stdout=False, redirect_stderr=False,
            )  # fmt: skip
            self._task = self._live.add_task("", total=None)

    def __enter__(self: _P) -> _P:
        if self._live is not None:
            self._live.start()
        self.tick()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def log(self, line: str) -> None:
        """Print a line; on a terminal above the status."""
        self._console.print(self._prefix + line)

    def show(self, status: str, done: int = 0, total: int = 0) -> None:
        """Set the status and the counts; another total or a smaller count begins the next part of the work."""
        if total != self._total or done < self._done:
            self._total, self._first, self._since_ns = total, done, time.monotonic_ns()
            if self._live is not None:
                self._live.reset(self._task, total=total or None)
            was_done = False
        else:
            was_done = self._done >= total
        self._status, self._done = status, done
        if self._live is not None:
            self._live.update(self._task, completed=done)
        self.tick(now=0 < total <= done and not was_done)

    def tick(self, *, now: bool = False) -> None:
        """Print the status if the period is over, or with `now` in any case; call this often during the work."""
        if self._live is not None or self._period_s is None:
            return
        now_ns = time.monotonic_ns()
        due = self._printed_ns is None or (now_ns - self._printed_ns) / 1e9 >= self._period_s
        if (due or now) and (line := self._line()):
            self._printed_ns = now_ns
            self.log(line)

    def _line(self) -> str:
        status = self._describe()
        if not self._total:
            return status
        rate = (self._done - self._first) / max((time.monotonic_ns() - self._since_ns) / 1e9, 1e-9)
        remaining = self._total - self._done
        left = f", {duration(remaining / rate)} to go" if rate > 0 and remaining > 0 else ""
        return f"{self._done} of {self._total} ({rate:.3g} /s{left}){', ' if status else ''}{status}"


class _StatusColumn(rich.ProgressColumn):
    """Column that shows the current status in one line."""

    def __init__(self, describe: Callable[[], str]) -> None:
        super().__init__()
        self._describe = describe

    def render(self, task: rich.Task) -> Text:
        return Text(self._describe(), overflow="ellipsis", no_wrap=True)


@dataclass(frozen=True)
class Stage:
    """One step of a build and its expected duration, s (of an earlier run, or a guess that is data)."""

    name: str
    expected_s: float


class StageWatch:
    """Handle of the stage that runs; `from_cache` marks its result as cached."""

    def __init__(self) -> None:
        self.cached = False

    def from_cache(self) -> None:
        """Exclude the stage from the estimate of this machine's speed, because it did no work."""
        self.cached = True


class BuildProgress:
    """Stage i of n with elapsed time, remaining time and peak memory.

    Used as a context manager around the whole build, with `stage` around each step in the order of `stages`.
    """

    def __init__(self, command: str, stages: Sequence[Stage], stream: TextIO | None = None) -> None:
        self._stages = list(stages)
        self._display = Progress(f"{command}: ", self.line, stream=stream)
        self._started_ns = self._stage_ns = time.monotonic_ns()
        self._index = -1
        self._detail = ""
        self.built_s: dict[str, float] = {}
        """Duration of every finished stage that did work, s."""

    def __enter__(self) -> BuildProgress:
        self._started_ns = self._stage_ns = time.monotonic_ns()
        self._display.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._display.__exit__()

    def log(self, line: str) -> None:
        """Print a line; on a terminal above the status."""
        self._display.log(line)

    def detail(self, text: str) -> None:
        """Set what the stage is doing, for the status."""
        self._detail = text
        self._display.tick()

    @contextmanager
    def stage(self, name: str) -> Iterator[StageWatch]:
        """Run one stage in this context; announced stages before it that never began count as done."""
        names = [stage.name for stage in self._stages]
        self._index, self._detail = names.index(name), ""
        self._stage_ns = time.monotonic_ns()
        watch = StageWatch()
        self._display.tick(now=True)
        yield watch
        took_s = (time.monotonic_ns() - self._stage_ns) / 1e9
        if not watch.cached:
            self.built_s[name] = took_s
        self.log(
            f"[{self._index + 1}/{len(names)}] {name}: {'from the cache' if watch.cached else 'done'}, {took_s:.1f} s"
        )

    def remaining_s(self) -> float:
        """Return the expected time to the end, s, at the speed of the finished stages."""
        if self._index < 0:
            return sum(stage.expected_s for stage in self._stages)
        expected = {stage.name: stage.expected_s for stage in self._stages}
        planned = sum(expected[name] for name in self.built_s)
        low, high = _RATE_LIMITS
        rate = min(max(sum(self.built_s.values()) / planned, low), high) if planned > 0 else 1.0
        spent_s = (time.monotonic_ns() - self._stage_ns) / 1e9
        later = sum(stage.expected_s for stage in self._stages[self._index + 1 :])
        return max(self._stages[self._index].expected_s * rate - spent_s, 0.0) + later * rate

    def line(self) -> str:
        """Return the status; empty before the first stage."""
        if self._index < 0:
            return ""
        elapsed_s = (time.monotonic_ns() - self._started_ns) / 1e9
        return (
            f"[{self._index + 1}/{len(self._stages)}] {self._stages[self._index].name} · "
            f"{duration(elapsed_s)} so far, {duration(self.remaining_s())} to go · "
            f"peak {peak_rss_bytes() / 1e9:.1f} GB{' · ' if self._detail else ''}{self._detail}"
        )
