"""Task of a worker: one episode to run; lightweight, so that a driver need not load the physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.results.store import EPISODES, VIDEOS
from sim_hil.benchmark.suite.episode import Episode, SuiteError

VIDEO_CHOICES = ("all", "failed", "none")


@dataclass(frozen=True)
class EpisodeTask:
    """One episode to run by a worker; its files are written below `folder`."""

    episode: Episode
    conditions: Conditions
    folder: Path
    video: str = "none"
    manifest_sha256: str = ""
    attempt: int = 1

    def __post_init__(self) -> None:
        if self.video not in VIDEO_CHOICES:
            raise ConditionsError(f"video {self.video!r}: expected one of {', '.join(VIDEO_CHOICES)}")
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

    def as_json(self) -> dict[str, Any]:
        """Return the task as JSON values, to be read by `of_json`."""
        values = {key: getattr(self, key) for key in ("video", "manifest_sha256", "attempt")}
        conditions = self.conditions.as_json()
        return {**values, "episode": asdict(self.episode), "conditions": conditions, "folder": str(self.folder)}

    @staticmethod
    def of_json(content: Mapping[str, Any]) -> EpisodeTask:
        """Read a task written by `as_json`. Raises ConditionsError or SuiteError."""
        try:
            raw: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in content["episode"].items()}
            rest = {key: content[key] for key in ("video", "manifest_sha256", "attempt")}
            conditions = Conditions.of_json(content["conditions"])
            return EpisodeTask(Episode(**raw), conditions, Path(content["folder"]), **rest)
        except (KeyError, TypeError, AttributeError) as error:
            raise SuiteError(f"task: expected a worker's task as written by edge-bench ({error!r})") from error
