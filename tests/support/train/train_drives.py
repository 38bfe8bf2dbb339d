"""Made-up recorded drives: small, with answers that depend on what is seen, or an arc with a number in each image."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.state.reasoning_text import Progress
from export.model.config import PRESETS, TicVlaConfig
from tools.train.config.collect import TRACE_EVERY
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, PICTURE_PX, About, Dataset, Drive, Entry
from tools.train.drives.futures import label_futures, relative

WORDINGS = ("Turn left, then stop at the desk.", "Take the first left and wait at the desk.")
VAL_LAYOUT = 106
"""Of kind office; 100 and 101 are for training."""


def tiny_model() -> TicVlaConfig:
    """`nano` with narrow layers and one language token a frame; its own vocabulary and special tokens."""
    nano = PRESETS["nano"]
    vision = dataclasses.replace(nano.vision, image_px=32, hidden=24, layers=1, mlp=32, token_dim=32)
    language = dataclasses.replace(nano.language, hidden=32, layers=2, head_dim=8, mlp=48)
    action = dataclasses.replace(nano.action, hidden=32, layers=1, ffn=32)
    return dataclasses.replace(nano, vision=vision, language=language, action=action)


def pose_at(k: int) -> tuple[float, float, float]:
    """0.5 m/s straight ahead for 8 s, then a quarter turn to the left within 2 s, then on."""
    if k <= 80:
        return (0.05 * k, 0.0, 0.0)
    if k <= 100:
        angle = pi / 2 * (k - 80) / 20
        return (4.0 + 0.6 * sin(angle), 0.6 * (1 - cos(angle)), angle)
    return (4.6, 0.6 + 0.05 * (k - 100), pi / 2)


def progress_at(k: int) -> Progress:
    """Before the turn at frame 90 it is next and openings are passed, after it there is the last leg."""
    return Progress(1, 1, min(k // 30, 2)) if k < 90 else Progress(2, 1, 0)


def trace_at(k: int) -> Mapping[str, Any]:
    """As `Trace.to_json` writes it."""
    left = k < 90
    return {
        "situation": "in a corridor" if left else "in a room",
        "objects": "desk left 6 m, red chair right 3 m" if left else "none",
        "motion": "nobody near",
        "progress": dataclasses.asdict(progress_at(k)),
        "plan": "turn left into the room in 3 m" if left else "stop in 6 m",
    }


def made_up_drive(drive_id: str, frames: int = 130, *, layout_seed: int = 100, **about: Any) -> Drive:
    """A drive with traces; its pictures are all the same grey."""
    poses = np.array([pose_at(k) for k in range(frames)])
    traces = [{"k": k, **trace_at(k)} for k in range(0, frames, TRACE_EVERY)]
    facts: Mapping[str, Any] = {
        "kind": "office", "layout_seed": layout_seed, "scene": "office", "robot": "go2", "people": 0, "seed": 1,
        "driver": "expert", "drift": "none", "goal_xy": (4.6, 4.0), "threshold_m": 1.5, "outcome": "reached",
        "collided": False, "wordings": WORDINGS, "told": (), "traces": tuple(traces), **about,
    }  # fmt: skip
    plan = np.array([[(s / 2, 0.0) for s in (3.0, 6.0, 9.0)]] * frames, np.float32)
    plan[:90, 2] = (3.0, 1.5)
    grey = cv2.imencode(".jpg", np.full((PICTURE_PX, PICTURE_PX, 3), 90, np.uint8))[1].reshape(-1)
    return Drive(
        about=About(id=drive_id, **facts),
        jpeg=np.tile(grey, frames),
        jpeg_end=len(grey) * np.arange(1, frames + 1),
        pose=poses,
        pose_odom=poses + np.array((7.0, -3.0, 0.0)),
        state=np.zeros((frames, 3), np.float32),
        future=np.zeros((frames, 50, 3), np.float32),
        future_steps=np.full(frames, 50, np.int16),
        plan_xy=plan,
        by=np.full(frames, EXPERT, np.uint8),
    )


def write_dataset(folder: Path, drives: Sequence[Drive]) -> Dataset:
    """A data set of these drives."""
    with DatasetWriter(folder) as writer:
        for drive in drives:
            drive.save(writer.path(drive.id))
            writer.add(Entry.of(drive, writer.path(drive.id)))
        return writer.finish()


def small_dataset(folder: Path) -> Dataset:
    """Two drives to learn from (20 anchors) and one in a layout that is held out (7)."""
    drives = [
        made_up_drive("a"),
        made_up_drive("b", 65, layout_seed=101),
        made_up_drive("v", 65, layout_seed=VAL_LAYOUT),
    ]
    dataset = write_dataset(folder, drives)
    assert dataset.train == ("a", "b") and dataset.val == ("v",)
    return dataset


class MadeUpTokens:
    """f16 [N, 4, 32] a drive, seeded by frame, with a mark of whether the turn is still to come.

    With `every` 10 those of one frame a second, as a mirrored drive has them.
    """

    def __init__(self, every: int = 1) -> None:
        found = np.random.default_rng(5).standard_normal((130, 4, 32)).astype(np.float16) * np.float16(0.1)
        found[:90, :, 0] = 2.0
        self._tokens = found[::every]

    def frames(self, drive_id: str) -> np.ndarray:
        """The same for every drive."""
        return self._tokens


TURN_RADPS, SPEED_MPS = 0.2, 0.8


def about(name: str = "a", frames: int = 60, **changed: Any) -> About:
    """What holds for a made-up drive; a trace a second."""
    aspects = {"situation": "in a corridor", "objects": "none", "motion": "nobody near"}
    aspects["plan"] = "turn left into the room now"
    ks = range(0, frames, TRACE_EVERY)
    traces = tuple({"k": k, **aspects, "progress": {"step": 1, "steps": 1, "passed": k // 20}} for k in ks)
    values: dict[str, Any] = {
        "id": name, "kind": "office", "layout_seed": 100, "scene": "office-100", "robot": "go2", "people": 3, "seed": 7,
        "driver": "expert", "drift": "none", "goal_xy": (4.0, 0.0), "threshold_m": 1.5, "outcome": "reached",
        "collided": False, "wordings": tuple(f"turn left at door {i}" for i in range(8)), "told": (), "traces": traces,
    }  # fmt: skip
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
    """Write a data set of drives."""
    return write_dataset(folder, drives)
