"""Video of an episode: camera view, surrounding map, reasoning text, Δt and command.

Every second control period becomes a frame at 10 frames a second: twice real time. The file is complete or absent.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from functools import cache
from math import cos, hypot, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.crowd.people import PERSON_RADIUS_M
from sim_hil.scene.map import MapView, draw_map, draw_mark, draw_path, draw_pose, map_view

if TYPE_CHECKING:
    from sim_hil.benchmark.env.world import EpisodeWorld

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

EVERY: Final = 2
FPS: Final = 10
WIDTH, HEIGHT = 1280, 720
EYE_W, EYE_H = 800, 450
RENDER_W, RENDER_H = 640, 360  # rendered small, because software rendering dominates the cost, and then enlarged
MAP_PX_PER_M: Final = 24.0
CODEC: Final = "mp4v"  # a codec that browsers play (VP9) takes 40 times as long, longer than the episode itself
MAX_TEXT_CHARS: Final = 420

_PAPER: Colour = (250, 250, 248)
_INK: Colour = (29, 39, 51)
_MUTED: Colour = (107, 119, 133)
_ROBOT: Colour = (31, 111, 139)
_ODOMETRY: Colour = (209, 96, 61)
_PERSON: Colour = (138, 95, 191)
_GOAL: Colour = (44, 140, 74)
_PLAN: Colour = (230, 140, 20)
_BAD: Colour = (179, 38, 30)
_FONTS = Path(matplotlib.get_data_path()) / "fonts" / "ttf"


class EpisodeVideo:
    """Video writer: `add` every control period, then `keep` or `discard`. Raises OSError if it cannot write."""

    def __init__(self, path: Path, episode: Episode, instruction: str) -> None:
        self._path, self._episode, self._instruction = path, episode, instruction
        # The suffix is kept, because OpenCV derives the format from it.
        self._partial = path.with_name(f"{path.stem}.partial{path.suffix}")
        self._writer = _open(self._partial)
        self._periods = 0
        self._map: Picture | None = None
        self._view = MapView(0.0, 0.0, MAP_PX_PER_M)
        self._true: list[tuple[float, float]] = []
        self._reported: list[tuple[float, float]] = []

    def add(
        self,
        world: EpisodeWorld,
        observation: Observation,
        command: tuple[float, float, float],
        notes: Mapping[str, object],
    ) -> None:
        """Add a control period: its state, and the policy's command and notes."""
        pose = world.pose()
        start = SE2(*self._episode.start)
        reported = start @ observation.T_odom_base
        self._true.append((pose.x_m, pose.y_m))
        self._reported.append((reported.x_m, reported.y_m))
        self._periods += 1
        if (self._periods - 1) % EVERY:
            return
        frame = np.full((HEIGHT, WIDTH, 3), _PAPER, np.uint8)
        eye = world.picture(RENDER_W, RENDER_H)
        frame[:EYE_H, :EYE_W] = cv2.resize(eye, (EYE_W, EYE_H), interpolation=cv2.INTER_LINEAR)
        frame[:, EYE_W + 4 :] = self._draw_map(world, pose, notes)
        page = Image.fromarray(frame)
        self._write_panel(ImageDraw.Draw(page), world, observation, command, notes)
        self._writer.write(cv2.cvtColor(np.asarray(page), cv2.COLOR_RGB2BGR))

    def keep(self) -> None:
        """Finish the video and keep it. Raises OSError."""
        self._writer.release()
        self._partial.replace(self._path)

    def discard(self) -> None:
        """Remove the unfinished video, unless it was kept; may be called at any time."""
        self._writer.release()
        self._partial.unlink(missing_ok=True)

    def _draw_map(self, world: EpisodeWorld, pose: SE2, notes: Mapping[str, object]) -> Picture:
        if self._map is None:
            self._map = draw_map(world.scene, MAP_PX_PER_M, names=True)
            self._view = map_view(world.scene, MAP_PX_PER_M)
        width, height = WIDTH - EYE_W - 4, HEIGHT
        image, view = _around(self._map, self._view, (pose.x_m, pose.y_m), width, height)
        goal = self._episode.goal_xy
        draw_mark(image, view, goal, _GOAL, self._episode.threshold_m, filled=False)
        draw_mark(image, view, goal, _GOAL, 0.15)
        draw_path(image, view, self._reported, _ODOMETRY, 1)
        draw_path(image, view, self._true, _ROBOT, 2)
        for x, y, heading in world.people():
            draw_mark(image, view, (float(x), float(y)), _PERSON, PERSON_RADIUS_M)
            ahead = (float(x) + 0.5 * cos(heading), float(y) + 0.5 * sin(heading))
            draw_path(image, view, ((float(x), float(y)), ahead), _PERSON, 2)
        for point in _in_world(pose, notes):
            draw_mark(image, view, point, _PLAN, 0.12)
        draw_pose(image, view, pose.x_m, pose.y_m, pose.theta_rad, _BAD if world.touching else _ROBOT, 0.45)
        _point_to(image, view, goal)
        return image

    def _write_panel(
        self,
        draw: ImageDraw.ImageDraw,
        world: EpisodeWorld,
        observation: Observation,
        command: tuple[float, float, float],
        notes: Mapping[str, object],
    ) -> None:
        left, top, episode = 16, EYE_H + 12, self._episode
        lines = textwrap.wrap(f"“{self._instruction}”", 74)[:2]
        for line in lines:
            draw.text((left, top), line, _INK, _font("DejaVuSans-Bold.ttf", 17))
            top += 23
        about = f"{episode.id} · {episode.robot} · {episode.people} people · {observation.time_s:.1f} of "
        draw.text(
            (left, top), f"{about}{episode.timeout_s:.0f} s · twice real time", _MUTED, _font("DejaVuSans.ttf", 14)
        )
        top += 28
        delay_s = notes.get("delay_s")
        delay = "Δt –" if delay_s is None else f"Δt {delay_s:.1f} s"
        driven = f"v {command[0]:+.2f} m/s   ω {command[2]:+.2f} rad/s"
        draw.text((left, top), delay, _INK, _font("DejaVuSans-Bold.ttf", 22))
        draw.text((left + 150, top + 3), driven, _INK, _font("DejaVuSansMono.ttf", 17))
        goal_m = hypot(world.pose().x_m - episode.goal_xy[0], world.pose().y_m - episode.goal_xy[1])
        draw.text((left + 480, top + 3), f"goal {goal_m:.1f} m", _GOAL, _font("DejaVuSans-Bold.ttf", 17))
        if world.collided:
            draw.text((left + 620, top + 3), "has collided", _BAD, _font("DejaVuSans-Bold.ttf", 17))
        top += 36
        says = _state_line(notes)
        if says:
            draw.text((left, top), says, _BAD if notes.get("says") else _MUTED, _font("DejaVuSans.ttf", 14))
            top += 22
        text = _printable(str(notes.get("text", "") or ""))[:MAX_TEXT_CHARS]
        for line in textwrap.wrap(text, 92)[: (HEIGHT - top - 6) // 18]:
            draw.text((left, top), line, _INK, _font("DejaVuSansMono.ttf", 13))
            top += 18


def last_picture(path: Path, width_px: int) -> bytes | None:
    """Return the last frame of a video as JPEG of that width; None if the video cannot be read."""
    video = cv2.VideoCapture(str(path))
    try:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        video.set(cv2.CAP_PROP_POS_FRAMES, max(0, count - 1))
        found, picture = video.read()
    finally:
        video.release()
    if not found:
        return None
    height_px = round(picture.shape[0] * width_px / picture.shape[1])
    small = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes())


def _open(path: Path) -> cv2.VideoWriter:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), FPS, (WIDTH, HEIGHT))
    if not writer.isOpened():
        raise OSError(f"{path}: OpenCV cannot write video with the codec {CODEC}; run with --video none")
    return writer


def _around(
    whole: Picture, view: MapView, centre: tuple[float, float], width: int, height: int
) -> tuple[Picture, MapView]:
    """Return a copy of the map around a point, and its view; a smaller map is centred."""
    spans: list[tuple[int, int, int]] = []
    for at, size, window in zip(view.pixel(centre), (whole.shape[1], whole.shape[0]), (width, height), strict=True):
        if size <= window:
            spans.append((0, size, (window - size) // 2))
        else:
            first = min(max(at - window // 2, 0), size - window)
            spans.append((first, first + window, 0))
    (left, right, dx), (top, bottom, dy) = spans
    image = np.full((height, width, 3), 255, np.uint8)
    image[dy : dy + bottom - top, dx : dx + right - left] = whole[top:bottom, left:right]
    scale = view.px_per_m
    return image, MapView(view.x0_m + (left - dx) / scale, view.y1_m - (top - dy) / scale, scale)


def _point_to(image: Picture, view: MapView, goal: tuple[float, float]) -> None:
    """Draw an arrow at the edge if the goal lies outside the image."""
    (x, y), (height, width) = view.pixel(goal), image.shape[:2]
    if 0 <= x < width and 0 <= y < height:
        return
    dx, dy = x - width / 2, y - height / 2
    share = min((width / 2 - 24) / max(abs(dx), 1e-6), (height / 2 - 24) / max(abs(dy), 1e-6))
    tip = (round(width / 2 + dx * share), round(height / 2 + dy * share))
    length = hypot(dx, dy)
    tail = (round(tip[0] - 40 * dx / length), round(tip[1] - 40 * dy / length))
    cv2.arrowedLine(image, tail, tip, _GOAL, 4, cv2.LINE_AA, tipLength=0.45)


def _in_world(pose: SE2, notes: Mapping[str, Any]) -> Iterable[tuple[float, float]]:
    """Yield the policy's target point, or else its waypoints, in the world frame, m."""
    target = notes.get("target")
    points = [target[:2]] if target is not None else notes.get("waypoints") or []
    for x, y in points:
        there = pose @ SE2(float(x), float(y), 0.0)
        yield (there.x_m, there.y_m)


def _state_line(notes: Mapping[str, object]) -> str:
    if notes.get("says"):
        return str(notes["says"])[:110]
    parts = []
    if notes.get("thinking_s") is not None:
        parts.append(f"reasoning for {notes['thinking_s']:.1f} s")
    if notes.get("reason") not in (None, "ok"):
        parts.append(f"stands: {notes['reason']}")
    if notes.get("generation") is not None:
        parts.append(f"drives by generation {notes['generation']}")
    return " · ".join(parts)


def _printable(text: str) -> str:
    """Replace characters of an untrusted text that would break a line or change the writing direction."""
    return "".join(c if c.isprintable() else " " for c in text)


@cache
def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(_FONTS / name), size)
