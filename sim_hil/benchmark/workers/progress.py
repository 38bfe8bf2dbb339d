"""Progress of a benchmark run on stderr: a bar on a terminal, otherwise a line per episode."""

from __future__ import annotations

from reporting.progress import Progress
from sim_hil.benchmark.results.record import EpisodeResult, FailedRun
from sim_hil.benchmark.workers.jobs import RunWatcher

SHOWN = 4


class BenchProgress(Progress):
    """Progress display; pass `watcher` to the run."""

    def __init__(self, total: int, done: int, *, blind: bool = False) -> None:
        """`blind`: show counts, and no single episode."""
        super().__init__("", bar=True, period_s=None)
        self._blind = blind
        self._episodes, self._ended = total, done
        self._reached = 0
        self._collided = 0
        self._times: dict[str, float] = {}
        self._advance()

    @property
    def watcher(self) -> RunWatcher:
        """Callbacks for the run."""
        return RunWatcher(self._finished, self._failed, self._retried, self._running)

    def _finished(self, result: EpisodeResult) -> None:
        self._ended += 1
        end = "reached" if result.success else result.end
        hit = f", collided with {', '.join(result.collisions)}" if result.collided else ""
        took = f"{result.time_s:.0f} s simulated in {result.wall_s:.0f} s"
        what = f"{result.id}: {end}, {result.ne_m:.1f} m from the goal{hit}; "
        self.log(f"[{self._ended}/{self._episodes}] {'' if self._blind else what}{took}")
        self._reached += result.success
        self._collided += result.collided
        self._advance()

    def _failed(self, failed: FailedRun) -> None:
        self._ended += 1
        self.log(f"[{self._ended}/{self._episodes}] {failed.id}: FAILED {failed.attempts} times: {failed.why}")
        self._advance()

    def _retried(self, episode_id: str, why: str) -> None:
        self.log(f"{episode_id}: runs again: {why}")

    def _advance(self) -> None:
        at = ", ".join(f"{time_s:.0f} s" for time_s in sorted(self._times.values(), reverse=True)[:SHOWN])
        status = f"{self._reached} reached, {self._collided} collided{'; at ' if at else ''}{at}"
        self.show(status, self._ended, self._episodes)

    def _running(self, times: dict[str, float]) -> None:
        self._times = times
        self._advance()
