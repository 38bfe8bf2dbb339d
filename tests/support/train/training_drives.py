"""Made-up drives for tests of what reads them: a walk in an arc, pictures that show their frame's number."""

from __future__ import annotations

from math import cos, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, About, Dataset, Drive, Entry
from tools.train.drives.futures import label_futures, relative

TURN_RADPS, SPEED_MPS = 0.2, 0.8


def about(name: str = "a", frames: int = 60, **changed: Any) -> About:
    """What holds for a made-up drive; a trace a second."""
    traces = tuple(
        {
            "k": k,
            "situation": "in a corridor",
            "objects": "none",
            "motion": "nobody near",
            "progress": {"step": 1, "steps": 1, "passed": k // 20},
            "plan": "turn left into the room now",
        }
        for k in range(0, frames, 10)
    )
    values: dict[str, Any] = {
        "id": name,
        "kind": "office",
        "layout_seed": 100,
        "scene": "office-100",
        "robot": "go2",
        "people": 3,
        "seed": 7,
        "driver": "expert",
        "drift": "none",
        "goal_xy": (4.0, 0.0),
        "threshold_m": 1.5,
        "outcome": "reached",
        "collided": False,
        "wordings": tuple(f"turn left at door {i}" for i in range(8)),
        "told": (),
        "traces": traces,
    }
    return About(**{**values, **changed})


def arc(frames: int, start: tuple[float, float, float] = (1.0, 2.0, 0.5)) -> NDArray[np.float64]:
    """[n, 3]: poses 0.1 s apart on an arc from `start`, at SPEED_MPS and TURN_RADPS."""
    x, y, heading = start
    radius = SPEED_MPS / TURN_RADPS
    turned = heading + TURN_RADPS * np.arange(frames) / 10
    return np.stack(
        (x + radius * (np.sin(turned) - sin(heading)), y - radius * (np.cos(turned) - cos(heading)), turned), axis=1
    )


def drive(name: str = "a", frames: int = 60, pose: NDArray[np.float64] | None = None, **changed: Any) -> Drive:
    """A drive along poses; odometry begins at zero and is 1 % long; `changed` is of `about`."""
    poses = arc(frames) if pose is None else pose
    odometry = relative(poses[0], poses)
    odometry[:, :2] *= 1.01
    jpegs = [_jpeg(k) for k in range(frames)]
    future, steps = label_futures(poses, np.zeros((frames, FUTURE_STEPS, 3)), np.full(frames, EXPERT), goes_on=False)
    return Drive(
        about=about(name, frames, **changed),
        jpeg=np.concatenate(jpegs),
        jpeg_end=np.cumsum([len(jpeg) for jpeg in jpegs]).astype(np.int64),
        pose=poses,
        pose_odom=odometry,
        state=np.tile(np.array((SPEED_MPS, 0.0, TURN_RADPS), np.float32), (frames, 1)),
        future=future.astype(np.float32),
        future_steps=steps.astype(np.int16),
        plan_xy=np.tile(np.array(((2.4, 0.0), (4.8, 0.0), (7.2, 0.0)), np.float32), (frames, 1, 1)),
        by=np.full(frames, EXPERT, np.uint8),
    )


def _jpeg(k: int) -> NDArray[np.uint8]:
    """A red picture as bright as its number, above a blue one."""
    picture = np.zeros((128, 128, 3), np.uint8)
    picture[:64, :, 0] = 60 + k % 180
    picture[64:, :, 2] = 200
    done, jpeg = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert done
    return np.asarray(jpeg, np.uint8).ravel()


def dataset(folder: Path, *drives: Drive) -> Dataset:
    """A data set of drives."""
    with DatasetWriter(folder) as writer:
        for each in drives:
            each.save(writer.path(each.id))
            writer.add(Entry.of(each, writer.path(each.id)))
        return writer.finish()
