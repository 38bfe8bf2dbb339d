"""Log of one episode, one row per control period: source of the report's maps and histograms."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import write_whole
from edge.core.geometry import SE2
from edge.core.stats import percentiles

COLUMNS = ("time_s", "x_m", "y_m", "theta_rad", "odom_x_m", "odom_y_m", "vx_mps", "vy_mps", "wz_radps", "delay_s")
"""True pose, odometry position, command, semantic delay (null while there is no semantic state)."""


@dataclass
class EpisodeLog:
    """Log with one row per control period; generations and final positions of people are added on writing."""

    rows: list[tuple[float | None, ...]] = field(default_factory=list)

    def add(
        self, time_s: float, T_world_base: SE2, T_odom_base: SE2, command: tuple[float, float, float],
        delay_s: float | None,
    ) -> None:  # fmt: skip
        """Add a period: the state at its beginning, and its command."""
        odom = T_odom_base.as_tuple()[:2]
        self.rows.append((time_s, *T_world_base.as_tuple(), *odom, *command, delay_s))

    def delay_summary(self) -> dict[str, float] | None:
        """Return mean, p50, p99 and max of the delays, s; None if there are none."""
        delays = [row[-1] for row in self.rows if row[-1] is not None]
        if not delays:
            return None
        points = percentiles(delays, "p50", "p99", "max")
        mean = round(sum(delays) / len(delays), 4)
        return {"mean": mean, **{name: value for name, value in points.items() if value is not None}}

    def write(
        self,
        path: Path,
        generations: Sequence[Mapping[str, object]],
        people: NDArray[np.float64],
        goal_xy: Sequence[float],
    ) -> None:
        """Write the log as JSON. Raises OSError."""
        columns = {
            name: [None if row[i] is None else round(float(row[i] or 0.0), 4) for row in self.rows]
            for i, name in enumerate(COLUMNS)
        }
        places = [[round(float(v), 3) for v in row] for row in people]
        content = {"columns": columns, "generations": list(generations), "people": places, "goal_xy": list(goal_xy)}
        write_whole(path, json.dumps(content) + "\n")


def read_log(path: Path) -> dict[str, Any]:
    """Read a log written by `EpisodeLog.write`. Raises OSError or ValueError."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict) or set(content) != {"columns", "generations", "people", "goal_xy"}:
        raise ValueError(f"{path}: expected the log of an episode")
    if set(content["columns"]) != set(COLUMNS):
        raise ValueError(f"{path}: expected the columns {', '.join(COLUMNS)}")
    return content
