"""The bridge's log: lines in order, and a stream that stalls holds nobody up."""

from __future__ import annotations

import io
import threading

from firmware_bridge.system.line_log import LineLog


class StalledStream(io.StringIO):
    """A stream that takes nothing until `flowing` is set."""

    def __init__(self) -> None:
        super().__init__()
        self.flowing = threading.Event()

    def write(self, text: str) -> int:
        self.flowing.wait(10)
        return super().write(text)


def test_lines_come_out_in_order_with_their_prefix() -> None:
    stream = io.StringIO()
    log = LineLog(stream, "edge-bridge")
    for line in ("armed", "stopped"):
        log.write(line)
    log.close(5.0)
    assert stream.getvalue() == "edge-bridge: armed\nedge-bridge: stopped\n"


def test_a_stalled_stream_delays_no_caller_and_excess_lines_are_counted() -> None:
    stream = StalledStream()
    log = LineLog(stream, "edge-bridge", capacity=4)
    for number in range(100):
        log.write(str(number))
    assert log.dropped >= 95
    log.close(0.05)
    assert stream.getvalue() == ""
    stream.flowing.set()


def test_a_closed_stream_is_survived() -> None:
    stream = io.StringIO()
    stream.close()
    log = LineLog(stream, "edge-bridge")
    log.write("anybody there?")
    log.close(5.0)
