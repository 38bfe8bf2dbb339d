"""Bus of the simulated base with a queue in each direction: one thread receives and one sends."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from typing import Final

import can

from firmware_bridge.can.buses import BusError
from firmware_bridge.can.frame import Frame

_LISTEN_S: Final = 0.1
_SEND_QUEUE: Final = 1024
"""Frames that wait, 2 s of the Carter's: after a pause of the computer it sends them late instead of never."""
_RECEIVE_QUEUE: Final = 4096
_SEND_S: Final = 0.05
_END_S: Final = 1.0


class BusLink:
    """Link to a bus whose `send` and `receive` never wait; frames are stamped with time.monotonic_ns."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._received: deque[tuple[int, Frame]] = deque(maxlen=_RECEIVE_QUEUE)
        self._arrived = threading.Event()
        self._to_send: queue.Queue[Frame | None] = queue.Queue(_SEND_QUEUE)
        self._ending = False
        self._failure: Exception | None = None
        self.sent = 0
        self.unsent = 0
        self.received = 0
        self._threads = [
            threading.Thread(target=work, name=f"can-{work.__name__}", daemon=True)
            for work in (self._listen, self._send_all)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def line_errors(self) -> int:
        """Number of invalid serial frames or multicast datagrams."""
        return int(getattr(self._bus, "line_errors", 0))

    @property
    def pending(self) -> int:
        """Number of frames that are not sent yet, with the one being sent."""
        return self._to_send.unfinished_tasks

    def send(self, frame: Frame) -> None:
        """Queue a frame; if the queue is full, because the line takes no data, the frame counts as `unsent`."""
        try:
            self._to_send.put_nowait(frame)
        except queue.Full:
            self.unsent += 1

    def receive(self) -> list[tuple[int, Frame]]:
        """Return the frames since the last call with their receive times, ns. Raises BusError if the bus was lost."""
        if self._failure is not None:
            raise BusError(f"CAN bus {self._bus.channel_info}: connection lost: {self._failure}")
        self._arrived.clear()
        received = []
        while self._received:
            received.append(self._received.popleft())
        return received

    def wait(self, left_ns: int) -> None:
        """Wait until a frame arrives, at most `left_ns`."""
        self._arrived.wait(left_ns / 1e9)

    def close(self) -> None:
        """End both threads and close the bus; may be called twice."""
        if self._ending:
            return
        self._ending = True
        with contextlib.suppress(queue.Full):  # then the thread checks _ending after the next frame
            self._to_send.put_nowait(None)
        for thread in self._threads:
            thread.join(_END_S)
        self._bus.shutdown()

    def _listen(self) -> None:
        while not self._ending:
            try:
                message = self._bus.recv(_LISTEN_S)
            except (can.CanError, OSError, TypeError) as error:  # TypeError: pyserial, closed while it reads
                if not self._ending:
                    self._failure = error
                    self._arrived.set()
                return
            if message is not None and (message.is_error_frame or _is_ours(message)):
                self._note(message)

    def _note(self, message: can.Message) -> None:
        frame = Frame(message.arbitration_id, bytes(message.data[:8]), error=message.is_error_frame)
        self._received.append((time.monotonic_ns(), frame))
        self.received += 1
        self._arrived.set()

    def _send_all(self) -> None:
        while not self._ending:
            frame = self._to_send.get()
            if frame is None:
                return
            message = can.Message(
                arbitration_id=frame.identifier,
                data=frame.data,
                is_extended_id=False,
                is_error_frame=frame.error,
            )
            try:
                self._bus.send(message, timeout=_SEND_S)
                self.sent += 1
            except (can.CanError, OSError):  # no receiver, full queue or bus off: the frame is lost, as on a real bus
                self.unsent += 1
            self._to_send.task_done()


def _is_ours(message: can.Message) -> bool:
    return not (message.is_remote_frame or message.is_extended_id)
