"""Hand-over of pictures between the thread that receives them and the camera thread of the runner: the newest wins."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from firmware_bridge.core.robot_state import CameraError

T = TypeVar("T")


class CameraSource(Protocol):
    """Where camera pictures come from. One caller at a time."""

    @property
    def captured_ns(self) -> int | None:
        """Capture stamp (monotonic ns) of the picture returned last; None: the source does not know it."""

    def request_frame(self, timeout_s: float) -> bytes:
        """Return the newest picture that was not yet returned, as JPEG; wait at most `timeout_s`.

        Raises CameraError with one line.
        """

    def close(self) -> None:
        """End the source's threads without waiting for a device or a network."""


@dataclass
class NewestPicture(Generic[T]):
    """The newest picture of a receiving thread, or why there is none. Older pictures are overwritten unread."""

    name: str
    """Source of the pictures, for messages."""
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _picture: tuple[T, int] | None = None
    _error: str = "no picture yet"

    def put(self, picture: T, captured_ns: int) -> None:
        """Offer a picture and its capture stamp; called by the receiving thread."""
        with self._changed:
            self._picture, self._error = (picture, captured_ns), "no new picture"
            self._changed.notify_all()

    def fail(self, error: str) -> None:
        """Report in one line why no picture comes; called by the receiving thread."""
        with self._changed:
            self._error = error

    def take(self, timeout_s: float) -> tuple[T, int]:
        """Return the newest picture not yet taken and its capture stamp. Raises CameraError after `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._picture is not None, timeout_s)
            if self._picture is None:
                raise CameraError(f"camera {self.name}: {self._error} within {timeout_s * 1e3:.0f} ms")
            taken, self._picture = self._picture, None
            return taken


class Backoff:
    """Waiting times between attempts to open a source: doubled from 0.2 s to 5 s, reset by a picture."""

    FIRST_S = 0.2
    LONGEST_S = 5.0

    def __init__(self) -> None:
        self._next_s = self.FIRST_S

    def reset(self) -> None:
        """Begin again with the shortest time."""
        self._next_s = self.FIRST_S

    def next_s(self) -> float:
        """Return the time to wait now, s."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, self.LONGEST_S)
        return wait_s


class ReceivingThread:
    """A daemon thread that runs `attempt` until close(), with a growing pause after each end of it.

    `attempt(closing)` receives pictures until `closing` is set or the source fails, and raises CameraError then. It
    calls the back-off's `reset` with every picture.
    """

    def __init__(self, attempt: Callable[[threading.Event, Backoff], None], fail: Callable[[str], None]) -> None:
        self._attempt, self._fail = attempt, fail
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera-source", daemon=True)
        self._thread.start()

    def close(self, wait_s: float = 0.5) -> None:
        """End the thread. One that is inside a driver's call ends later by itself."""
        self._closing.set()
        self._thread.join(wait_s)

    def _run(self) -> None:
        backoff = Backoff()
        while not self._closing.is_set():
            try:
                self._attempt(self._closing, backoff)
            except CameraError as error:
                self._fail(str(error))
            except Exception as error:  # noqa: BLE001 - a driver's surprise must not end the camera for good
                self._fail(f"{type(error).__name__}: {error}".splitlines()[0])
            self._closing.wait(backoff.next_s())


def deadline_left_s(deadline_ns: int) -> float:
    """Return the time left until a monotonic deadline, s; 0 after it."""
    return max(deadline_ns - time.monotonic_ns(), 0) / 1e9
