"""Camera faults: answers of the video service that are missing, late, repeated, stale or wrong."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_hil.protocols.render_process import encode_jpeg
from sim_hil.protocols.unitree.fault_commands import CLEAR, FaultCommand, FaultCommandError, parse
from sim_hil.protocols.unitree.services.service import Received, ServiceServer
from sim_hil.protocols.unitree.video_service import VideoHub
from sim_hil.simulation.sensor_noise import SensorNoise

_HISTORY_NS: Final = 5_000_000_000
_NOISE_LEVELS: Final = 4  # grey levels of noise in an image of a covered or blinded camera
_READ_BYTES: Final = 4096
_CLOCK_SHARE: Final = (0.4, 0.1)  # size of a drawn clock as a share of the image's width and height


class FaultyVideoHub(VideoHub):
    """Video service whose faults are switched by lines on a descriptor; its end of file ends the process."""

    def __init__(
        self,
        server: ServiceServer,
        render: Callable[[], bytes | None],
        report: Callable[[dict[str, object]], None],
        show: Callable[[bytes], None] = lambda jpeg: None,
        *,
        size: tuple[int, int],
        commands_fd: int,
    ) -> None:
        """Create the service; `size`: image size (width, height), px; `commands_fd`: descriptor of the commands."""
        super().__init__(server, render, report, show)
        self._size = size
        self._fd = commands_fd
        os.set_blocking(commands_fd, False)
        self._partial = b""
        self._on: dict[str, FaultCommand] = {}
        self._unreported: set[str] = set()
        self._held: list[Received] = []
        self._due: deque[tuple[int, Received, bytes]] = deque()
        self._history: deque[tuple[int, bytes]] = deque()
        self._frozen: bytes | None = None
        self._stale: deque[bytes] = deque()
        self._capture_ns = 0
        self._rng = np.random.default_rng(0)
        self._sensor = SensorNoise(*size, seed=0)

    def listen(self) -> bool:
        """Read the commands; return False if the sender has closed the descriptor."""
        try:
            data = os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return True
        if not data:
            return False
        *lines, self._partial = (self._partial + data).split(b"\n")
        for line in lines:
            try:
                self._switch(parse(line))
            except FaultCommandError as error:  # our own parent has checked it
                raise RuntimeError(f"camera faults: {error}") from error
        return True

    def _switch(self, command: FaultCommand) -> None:
        if command.fault == CLEAR:
            self._on.clear()
            self._unreported.clear()
            self._thaw()
        elif command.on:
            self._on[command.fault] = command
            self._unreported.add(command.fault)
            self._thaw()
            if command.fault == "camera-stop":  # takes effect at once: no answer from now on
                self._took_effect()
        else:
            self._on.pop(command.fault, None)
            self._unreported.discard(command.fault)
            self._report({"event": "fault", "fault": command.fault, "t_ns": time.monotonic_ns()})

    def _thaw(self) -> None:
        self._frozen = None
        self._stale.clear()

    def _took_effect(self) -> None:
        for name in sorted(self._unreported):
            self._report({"event": "fault", "fault": name, "t_ns": time.monotonic_ns()})
        self._unreported.clear()

    def _answer(self, waiting: list[Received]) -> None:
        now_ns = time.monotonic_ns()
        waiting = self._held + waiting
        self._held = []
        if "camera-stop" in self._on:
            waiting = []
        rate = self._on.get("camera-half-rate")
        if rate is not None and waiting:
            period_ns = round(1e9 / rate.number("rate_hz"))
            if now_ns - self._capture_ns < period_ns:
                self._took_effect()
                self._held, waiting = waiting, []
            else:
                self._capture_ns = now_ns
        super()._answer(waiting)
        while self._due and (self._due[0][0] <= now_ns or "camera-slow" not in self._on):
            _, request, jpeg = self._due.popleft()
            super()._send(request, jpeg)

    def _send(self, request: Received, jpeg: bytes) -> None:
        now_ns = time.monotonic_ns()
        self._history.append((now_ns, jpeg))
        while now_ns - self._history[0][0] > _HISTORY_NS:
            self._history.popleft()
        jpeg = self._spoiled(jpeg, now_ns)
        slow = self._on.get("camera-slow")
        self._took_effect()
        if slow is not None:
            self._due.append((now_ns + round(slow.number("delay_s") * 1e9), request, jpeg))
        else:
            super()._send(request, jpeg)

    def _spoiled(self, jpeg: bytes, now_ns: int) -> bytes:
        on, (width, height) = self._on, self._size
        if {"camera-freeze", "camera-frozen-clock", "camera-frozen-noise"} & on.keys():
            self._frozen = self._frozen or jpeg
            jpeg = self._frozen
        if "camera-frozen-clock" in on:
            jpeg = encode_jpeg(_with_clock(_decoded(jpeg), now_ns))
        if "camera-frozen-noise" in on:
            jpeg = encode_jpeg(self._sensor.add(_decoded(jpeg)))
        if "camera-stale-buffers" in on:
            jpeg = self._next_stale(round(on["camera-stale-buffers"].number("buffers")))
        if "camera-stale" in on:
            then_ns = now_ns - round(on["camera-stale"].number("delay_s") * 1e9)
            jpeg = next((old for t_ns, old in reversed(self._history) if t_ns <= then_ns), self._history[0][1])
        if "camera-black" in on:
            jpeg = encode_jpeg(self._noise(width, height, 0))
        if "camera-saturated" in on:
            jpeg = encode_jpeg(self._noise(width, height, 256 - _NOISE_LEVELS))
        if "camera-wrong-size" in on:
            wrong = on["camera-wrong-size"]
            size = (round(wrong.number("width")), round(wrong.number("height")))
            jpeg = encode_jpeg(cv2.resize(_decoded(jpeg), size).astype(np.uint8))
        if "camera-torn" in on:
            jpeg = jpeg[: round(len(jpeg) * on["camera-torn"].number("share"))]
        return jpeg

    def _next_stale(self, buffers: int) -> bytes:
        """Return the next of the images that are repeated in turn."""
        if not self._stale:
            self._stale.extend(jpeg for _, jpeg in list(self._history)[-buffers:])
        self._stale.rotate(-1)
        return self._stale[-1]

    def _noise(self, width: int, height: int, floor: int) -> NDArray[np.uint8]:
        return self._rng.integers(floor, floor + _NOISE_LEVELS, (height, width, 3), dtype=np.uint8, endpoint=False)


def _decoded(jpeg: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG of this process to RGB [h, w, 3]."""
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None  # encoded by this process
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8)


def _with_clock(rgb: NDArray[np.uint8], now_ns: int) -> NDArray[np.uint8]:
    """Draw a clock (seconds and hundredths, white on black) into the upper left corner of an image."""
    height, width = rgb.shape[:2]
    box = (round(_CLOCK_SHARE[0] * width), round(_CLOCK_SHARE[1] * height))
    scale = box[1] / 40
    cv2.rectangle(rgb, (0, 0), box, (0, 0, 0), -1)
    text = f"{now_ns / 1e9 % 1e5:08.2f}"
    cv2.putText(rgb, text, (2, round(0.8 * box[1])), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1)
    return rgb
