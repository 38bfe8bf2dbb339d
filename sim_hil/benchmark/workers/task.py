"""Task of a worker: one episode to run, and its record; lightweight, so that a driver need not load the physics."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edge.live.options import LiveOptions
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.env.metrics import Outcome
from sim_hil.benchmark.results.record import EpisodeLog, EpisodeResult
from sim_hil.benchmark.results.store import EPISODES, FLIGHTS, VIDEOS
from sim_hil.benchmark.suite.episode import Episode, SuiteError

VIDEO_CHOICES = ("all", "failed", "none")
FLIGHT_CHOICES = (*VIDEO_CHOICES, "causes")
"""Flight logs to keep; `causes`: none, but the cause of each failure."""


@dataclass(frozen=True)
class EpisodeTask:
    """One episode to run by a worker; its files are written below `folder`."""

    episode: Episode
    conditions: Conditions
    folder: Path
    video: str = "none"
    flights: str = "none"
    manifest_sha256: str = ""
    attempt: int = 1
    live: LiveOptions | None = None
    """Where the runner's live view listens, in real time."""

    def __post_init__(self) -> None:
        for name, choice, known in (("video", self.video, VIDEO_CHOICES), ("flights", self.flights, FLIGHT_CHOICES)):
            if choice not in known:
                raise ConditionsError(f"{name} {choice!r}: expected one of {', '.join(known)}")
        wordings = len(self.episode.instructions)
        if self.conditions.wording >= wordings:
            raise ConditionsError(
                f"wording {self.conditions.wording}: episode {self.episode.id} has {wordings}, counted from 0"
            )

    @property
    def instruction(self) -> str:
        """Instruction of the robot."""
        return self.episode.instructions[self.conditions.wording]

    @property
    def log_path(self) -> Path:
        """Path of the episode's log."""
        return self.folder / EPISODES / f"{self.episode.id}.json"

    @property
    def video_path(self) -> Path:
        """Path of the episode's video."""
        return self.folder / VIDEOS / f"{self.episode.id}.mp4"

    @property
    def flight_path(self) -> Path:
        """Path of the episode's flight log."""
        return self.folder / FLIGHTS / f"{self.episode.id}.mcap"

    def as_json(self) -> dict[str, Any]:
        """Return the task as JSON values, to be read by `of_json`."""
        values = {key: getattr(self, key) for key in ("video", "flights", "manifest_sha256", "attempt")}
        conditions = self.conditions.as_json()
        live = self.live
        values["live"] = None if live is None else [live.address, live.port, str(live.token_file)]
        return {**values, "episode": asdict(self.episode), "conditions": conditions, "folder": str(self.folder)}

    @staticmethod
    def of_json(content: Mapping[str, Any]) -> EpisodeTask:
        """Read a task written by `as_json`. Raises ConditionsError or SuiteError."""
        try:
            raw: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in content["episode"].items()}
            rest = {key: content[key] for key in ("video", "flights", "manifest_sha256", "attempt")}
            if content.get("live") is not None:
                address, port, token_file = content["live"]
                rest["live"] = LiveOptions(address, port, Path(token_file))
            conditions = Conditions.of_json(content["conditions"])
            return EpisodeTask(Episode(**raw), conditions, Path(content["folder"]), **rest)
        except (KeyError, TypeError, AttributeError) as error:
            raise SuiteError(f"task: expected a worker's task as written by edge-bench ({error!r})") from error


def episode_result(
    task: EpisodeTask, outcome: Outcome, log: EpisodeLog, *, generations: int | None, stopped_by: str, started_ns: int
) -> EpisodeResult:
    """Return the record of a finished task; `started_ns`: when it began, by time.monotonic_ns."""
    episode = task.episode
    return EpisodeResult(
        id=episode.id,
        task=episode.task,
        scene=episode.scene,
        people=episode.people,
        robot=episode.robot,
        seed=episode.seed,
        wording=task.conditions.wording,
        instruction=task.instruction,
        success=outcome.success,
        ne_m=outcome.ne_m,
        spl=100 * outcome.spl,
        collided=outcome.collided,
        collisions=outcome.collisions,
        first_collision_s=outcome.first_collision_s,
        fell=outcome.fell,
        end=outcome.end,
        path_m=outcome.path_m,
        shortest_m=outcome.shortest_m,
        time_s=outcome.time_s,
        timeout_s=episode.timeout_s,
        trajectory_sha256=outcome.trajectory_sha256,
        delay_s=log.delay_summary(),
        generations=generations,
        stopped_by=stopped_by,
        clock=task.conditions.clock,
        wall_s=round((time.monotonic_ns() - started_ns) / 1e9, 3),
        attempts=task.attempt,
        host=platform.node(),
    )
