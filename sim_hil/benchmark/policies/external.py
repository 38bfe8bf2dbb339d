"""Policy on a server, reached over `external_protocol`.

The server is untrusted: its answers are checked and its velocities clipped to the robot's limits. With a latency L, the
answer to the observation at time t takes effect at t + L; until then the previous command stays in force. Only one
request is open at a time, as with a model on the robot.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_bridge.core.config import LimitsConfig
from sim_hil.benchmark.conditions.latency import LatencyProfile, LatencySampler
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.external_protocol import (
    ENCODINGS,
    PROTOCOL,
    VERSION,
    Address,
    Channel,
    ExternalError,
    Message,
    check_keys,
    encode_image,
    numbers,
    text,
)
from sim_hil.benchmark.suite.episode import Episode

CONNECT_S = 10.0
CONTROL_PERIOD_S = 0.1
MAX_IMAGE_PX = 1280
MAX_WAYPOINTS = 32


class ExternalPolicy:
    """Policy on a server: one connection, to be closed. Methods raise ExternalError (one line) on a bad answer."""

    privileged = False

    def __init__(
        self, address: Address, limits: LimitsConfig, *, timeout_s: float, latency: LatencyProfile | None = None
    ) -> None:
        """Connect and shake hands."""
        self._limits, self._latency = limits, latency
        try:
            connection = address.connect(min(CONNECT_S, timeout_s))
        except OSError as error:
            raise ExternalError(
                f"policy server {address}: cannot be reached ({error.strerror or error}); start it first"
            ) from error
        self._channel = Channel(connection, f"policy server {address}", timeout_s)
        try:
            self._welcome()
        except BaseException:
            self._channel.close()
            raise
        self._sampler: LatencySampler | None = None
        self._step = 0
        self._due_ns = 0
        self._command = (0.0, 0.0, 0.0)
        self._answer: tuple[tuple[float, float, float], dict[str, Any]] | None = None
        self._asked_ns = 0
        self._seen_ns: int | None = None
        self._notes: dict[str, Any] = {}
        self.clipped = 0
        """Number of answers beyond the robot's limits so far in this episode."""

    def _welcome(self) -> None:
        peer = self._channel.peer
        hello = {"type": "hello", "protocol": PROTOCOL, "version": VERSION, "encodings": list(ENCODINGS)}
        self._channel.send(hello)
        header = self._channel.receive("welcome").header
        check_keys(header, {"protocol", "version", "name", "image"}, set(), peer)
        if header["protocol"] != PROTOCOL or header["version"] != VERSION:
            raise ExternalError(f"{peer}: expected {PROTOCOL} version {VERSION}, found {header['version']!r}"[:300])
        self.name = f"external:{text(header, 'name', peer, 80)}"
        self._image = header["image"]
        if self._image is None:
            return
        if not isinstance(self._image, dict):
            raise ExternalError(f"{peer}: expected image to be null or an object")
        check_keys(self._image, {"width", "height", "encoding"}, set(), peer)
        sides = (self._image["width"], self._image["height"])
        if not all(type(side) is int and 32 <= side <= MAX_IMAGE_PX for side in sides):
            raise ExternalError(f"{peer}: expected an image of 32 to {MAX_IMAGE_PX} pixels a side, found {sides}"[:300])
        if self._image["encoding"] not in ENCODINGS:
            raise ExternalError(f"{peer}: expected an image encoding of {', '.join(ENCODINGS)}")

    @property
    def needs_image(self) -> bool:
        """Whether the server requested images."""
        return self._image is not None

    @property
    def camera(self) -> tuple[int, int] | None:
        """Image size (width, height) that the server requested, px; None: no image."""
        return None if self._image is None else (self._image["width"], self._image["height"])

    def reset(self, episode: Episode, instruction: str, world: object | None, seed: int) -> None:
        """Announce an episode to the server, without information that a robot would not have.

        Episode id and seed are sent as hashes, because the id names the goal and the seed determines the crowd.
        """
        self._sampler = None if self._latency is None else LatencySampler(self._latency, seed, episode.id)
        self._step, self._due_ns, self._asked_ns, self.clipped = 0, 0, 0, 0
        self._command, self._answer, self._notes = (0.0, 0.0, 0.0), None, {}
        self._seen_ns = None
        digest = hashlib.sha256(f"{PROTOCOL} {seed} {episode.id}".encode()).hexdigest()
        self._channel.send(
            {
                "type": "reset",
                "episode": digest[:16],
                "robot": episode.robot,
                "instruction": instruction,
                "seed": int(digest[16:24], 16),
                "control_period_s": CONTROL_PERIOD_S,
                "limits": asdict(self._limits),
            }
        )
        check_keys(self._channel.receive("ready").header, set(), set(), self._channel.peer)

    def act(self, observation: Observation) -> tuple[float, float, float]:
        """Return the command in force after this observation."""
        now_ns = round(observation.time_s * 1e9)
        if self._answer is not None and now_ns >= self._due_ns:
            self._take()
        if self._answer is None:
            delay_ns = 0 if self._sampler is None else self._sampler.draw().total_ns
            self._answer, self._asked_ns, self._due_ns = self._ask(observation), now_ns, now_ns + delay_ns
            if delay_ns == 0:
                self._take()
        if self._seen_ns is not None:
            self._notes = {**self._notes, "delay_s": (now_ns - self._seen_ns) / 1e9}
        return self._command

    def _take(self) -> None:
        if self._answer is not None:
            self._command, self._notes = self._answer
            self._seen_ns, self._answer = self._asked_ns, None

    def _ask(self, observation: Observation) -> tuple[tuple[float, float, float], dict[str, Any]]:
        peer = self._channel.peer
        header: dict[str, Any] = {
            "type": "observe",
            "step": self._step,
            "time_s": observation.time_s,
            "state": list(observation.state),
            "pose": list(observation.T_odom_base.as_tuple()),
            "image": self._image,
        }
        self._channel.send(header, b"" if self._image is None else self._picture(observation.image))
        answer = self._channel.receive("act")
        check_keys(answer.header, {"step", "velocity"}, {"text", "waypoints"}, peer)
        if answer.header["step"] != self._step:
            raise ExternalError(f"{peer}: expected the answer to step {self._step}, found another")
        self._step += 1
        return self._within_limits(numbers(answer.header, "velocity", 3, peer)), _notes(answer, peer)

    def _picture(self, image: npt.NDArray[np.uint8] | None) -> bytes:
        if image is None or image.shape != (self._image["height"], self._image["width"], 3):
            raise ExternalError("expected an observation with an image of the size that the server requested")
        return encode_image(image, self._image["encoding"])

    def _within_limits(self, velocity: tuple[float, ...]) -> tuple[float, float, float]:
        limits, (vx, vy, wz) = self._limits, velocity
        cut = (
            min(max(vx, limits.vx_min_mps), limits.vx_max_mps),
            min(max(vy, -limits.vy_max_mps), limits.vy_max_mps),
            min(max(wz, -limits.wz_max_radps), limits.wz_max_radps),
        )
        self.clipped += cut != velocity
        return cut

    def notes(self) -> dict[str, Any]:
        """Return `delay_s` (age of the command's observation), the server's `text` and `waypoints`, and `clipped`."""
        return {**self._notes, "clipped": self.clipped}

    def close(self) -> None:
        """Announce the end to the server and close the connection."""
        with suppress(ExternalError):  # the server may have closed it already
            self._channel.send({"type": "bye"})
        self._channel.close()


def _notes(answer: Message, peer: str) -> dict[str, Any]:
    notes: dict[str, Any] = {"text": text(answer.header, "text", peer) if "text" in answer.header else ""}
    points = answer.header.get("waypoints")
    if points is None:
        return {**notes, "waypoints": None}
    if not isinstance(points, list) or len(points) > MAX_WAYPOINTS:
        raise ExternalError(f"{peer}: expected waypoints to be a list of at most {MAX_WAYPOINTS} points")
    return {**notes, "waypoints": [numbers({"waypoints": point}, "waypoints", 2, peer) for point in points]}
