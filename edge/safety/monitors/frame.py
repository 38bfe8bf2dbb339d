"""Checks the picture: stopped, frozen, stale, future, slow, black, saturated, torn, wrong size, swapped camera."""

from __future__ import annotations

import math
import zlib
from collections import OrderedDict, deque
from dataclasses import dataclass, field

import numpy as np

from edge.core.geometry import SE2
from edge.core.jpeg import jpeg_size
from edge.safety.faults.findings import Finding
from edge.safety.monitors.scene import SceneConfig, SceneMonitor
from edge.state.frame import Frame

DARK, BRIGHT = 8, 247
"""Grey levels of 255; a picture with nearly all values beyond one of these is black or saturated."""
SHOWS_NOTHING = 0.01
"""Share of the values that must lie between them in a usable picture."""
BAD_IN_A_ROW = 3
RATE_WINDOW_NS = 1_000_000_000
CONTENTS_KEPT = 32
"""Number of remembered picture contents: the largest number of buffers in a V4L2 driver's rotation."""
SLOW, TOO_SLOW = 0.65, 0.4
"""Shares of the expected pictures in a second; they detect the loss of half although the count is off by one."""


@dataclass(frozen=True)
class FrameConfig:
    """Expectations of the camera. With ticks of 100 ms and a bridge of 20 ms, its ages keep zero below 500 ms."""

    image_px: int | None
    """Side of the encoder's picture; None: not checked."""
    rate_hz: float
    """Pictures a second that the control thread receives: the camera's rate, at most that of the tick."""
    stopped_ms: float = 300.0
    """Age of the picture in use above which the velocity is zero."""
    stale_ms: float = 300.0
    """Age at first sight above which a picture is refused. Fault matrix row 3 gives 200 ms; a picture that arrives just
    after a tick waits one period more, which exceeds 200 ms with the camera's own 100 ms."""
    frozen_ms: float = 190.0
    """Age from which repeated content gives zero although the robot has moved since. At 10 Hz this is the second
    repetition of one picture, or the first repetition of two or more in turn."""
    moved_m: float = 0.02
    moved_rad: float = 0.02
    scene: SceneConfig = field(default_factory=SceneConfig)
    """Thresholds for a frozen picture that is not equal byte for byte."""

    def __post_init__(self) -> None:
        numbers = [value for value in vars(self).values() if not isinstance(value, SceneConfig)]
        if not all(value is None or value > 0 for value in numbers):
            raise ValueError(f"frame monitor: every value must be positive, found {self}")


@dataclass(frozen=True)
class FrameOutputs:
    """Whether the newest picture may be used, a hash of its content, and the findings."""

    usable: bool
    content: int
    findings: tuple[Finding, ...]


class FrameMonitor:
    """Remembers the last pictures' stamps and content, and small grey copies of some."""

    def __init__(self, config: FrameConfig) -> None:
        self._config = config
        self._seen_ns: int | None = None
        self._usable = False
        self._content = 0
        self._contents: OrderedDict[int, tuple[int, SE2]] = OrderedDict()
        self._scene = SceneMonitor(config.scene)
        self._frozen = ""
        self._refused = 0
        self._why = ""
        self._size: tuple[int, int] | None = None
        self._other_size = 0
        self._since_ns: int | None = None
        self._arrivals: deque[int] = deque(maxlen=max(4, 4 * round(config.rate_hz)))

    def step(self, picture: Frame | None, T_odom_base: SE2 | None, now_ns: int) -> FrameOutputs:
        """Judge the newest picture at `now_ns`; a picture that was seen before keeps its verdict.

        `T_odom_base`: the robot's pose when the picture was captured; None: unknown.
        """
        findings: list[Finding] = []
        if picture is not None and picture.stamp_ns > now_ns:
            ahead_ms = (picture.stamp_ns - now_ns) / 1e6
            findings.append(Finding("camera-from-future", f"{ahead_ms:.0f} ms ahead"))
            self._usable = False
        elif picture is not None and picture.stamp_ns != self._seen_ns:
            self._judge(picture, T_odom_base, now_ns, findings)
        if self._refused:
            findings.append(Finding("frame-refused", self._why))
        if self._refused >= BAD_IN_A_ROW:
            findings.append(Finding("frames-refused", self._why))
        if self._frozen:
            findings.append(Finding("camera-frozen", self._frozen))
        if self._other_size >= BAD_IN_A_ROW:
            findings.append(Finding("camera-swapped", self._why))
        self._judge_rate(now_ns, findings)
        return FrameOutputs(self._usable, self._content, tuple(findings))

    def age(self, driven_ns: int | None, now_ns: int) -> tuple[Finding, ...]:
        """Check the age since capture of the picture in use, whether camera or encoder delayed it."""
        age_ms = None if driven_ns is None else (now_ns - driven_ns) / 1e6
        if age_ms is not None and age_ms <= self._config.stopped_ms:
            return ()
        detail = "none yet" if age_ms is None else f"the picture in use is {age_ms:.0f} ms old"
        return (Finding("camera-stopped", detail),)

    def _judge(self, picture: Frame, T_odom_base: SE2 | None, now_ns: int, findings: list[Finding]) -> None:
        late = self._seen_ns is not None and picture.stamp_ns < self._seen_ns
        self._seen_ns = picture.stamp_ns
        self._arrivals.append(now_ns)
        self._since_ns = now_ns if self._since_ns is None else self._since_ns
        age_ms = (now_ns - picture.stamp_ns) / 1e6
        if late or age_ms > self._config.stale_ms:
            findings.append(Finding("camera-stale", f"{age_ms:.0f} ms old on arrival"))
            self._usable = False
            return
        self._why = self._defect(picture)
        self._usable = not self._why
        self._refused = 0 if self._usable else self._refused + 1
        if self._usable:
            self._judge_content(picture, T_odom_base)

    def _defect(self, picture: Frame) -> str:
        """Return the defect of the picture itself, for the operator; empty when it is good."""
        pixels, px = picture.pixels, self._config.image_px
        if pixels.ndim != 4 or pixels.dtype != np.uint8 or (px is not None and pixels.shape != (1, px, px, 3)):
            return f"expected {px}×{px} RGB, found {pixels.dtype}{list(pixels.shape)}"
        if picture.jpeg:
            if b"\xff\xd9" not in picture.jpeg[-32:]:
                return "torn: its JPEG has no end"
            size = jpeg_size(picture.jpeg)
            self._size = self._size or size
            if size != self._size and size is not None and self._size is not None:
                self._other_size += 1
                return "{}×{} where the first was {}×{}".format(*size, *self._size)
        self._other_size = 0
        sample = pixels[0, ::16, ::16]
        enough = SHOWS_NOTHING * sample.size
        if np.count_nonzero(sample > DARK) <= enough:
            return "black"
        if np.count_nonzero(sample < BRIGHT) <= enough:
            return "saturated"
        return ""

    def _judge_content(self, picture: Frame, T_odom_base: SE2 | None) -> None:
        # Every fourth line shows the same motion at a quarter of the cost.
        self._content = zlib.crc32(picture.pixels[0, ::4].tobytes())
        if T_odom_base is not None:
            scene = self._scene.step(picture.pixels, T_odom_base, picture.stamp_ns)
            self._frozen = self._repetition(picture.stamp_ns, T_odom_base) or scene

    def _repetition(self, stamp_ns: int, T_odom_base: SE2) -> str:
        """Return why this content counts as a repetition of an earlier picture; empty when it does not.

        A picture may repeat while the robot stands still, but not while it moves.
        """
        first_ns, T_odom_first = self._contents.setdefault(self._content, (stamp_ns, T_odom_base))
        # Keep a repeated picture: it must still be recognised once the robot has stopped because of it.
        self._contents.move_to_end(self._content)
        if len(self._contents) > CONTENTS_KEPT:
            self._contents.popitem(last=False)
        moved = T_odom_first.inverse() @ T_odom_base
        went_m, turned_rad = math.hypot(moved.x_m, moved.y_m), abs(moved.theta_rad)
        age_ms = (stamp_ns - first_ns) / 1e6
        far = went_m > self._config.moved_m or turned_rad > self._config.moved_rad
        if not far or age_ms < self._config.frozen_ms:
            return ""
        return f"the picture of {age_ms:.0f} ms ago again, {went_m:.2f} m and {math.degrees(turned_rad):.0f}° away"

    def _judge_rate(self, now_ns: int, findings: list[Finding]) -> None:
        if self._since_ns is None or now_ns - self._since_ns < RATE_WINDOW_NS:
            return
        while self._arrivals and now_ns - self._arrivals[0] >= RATE_WINDOW_NS:
            self._arrivals.popleft()
        expected = self._config.rate_hz * RATE_WINDOW_NS / 1e9
        detail = f"{len(self._arrivals)} in the last second, {expected:.0f} expected"
        if len(self._arrivals) < TOO_SLOW * expected:
            findings.append(Finding("camera-too-slow", detail))
        elif len(self._arrivals) <= SLOW * expected:
            findings.append(Finding("camera-slow", detail))
