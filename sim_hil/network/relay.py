"""Relay of packets over impaired links: one loop over all links, which sleeps until a packet arrives or is due."""

from __future__ import annotations

import contextlib
import heapq
import json
import os
import select
import socket
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from sim_hil.network.config import NetworkConfig, NetworkError, parse_impairment
from sim_hil.network.impairment import Direction
from sim_hil.network.ports import LEFT, Ends, Packet, open_ends

_NS: Final = 1_000_000_000
# Limits of the packets queued on all links; beyond either, new packets are lost. 64 MiB is 0.5 s at 1 Gbit/s.
_MAX_WAITING: Final = 100_000
_MAX_WAITING_BYTES: Final = 64 * 2**20
_MAX_LINE_BYTES: Final = 4000
_LONGEST_SLEEP_S: Final = 0.1


class Link:
    """One link: its ends and the impairments of both directions."""

    def __init__(self, name: str, ends: Ends, directions: tuple[Direction, Direction]) -> None:
        self.name = name
        self.ends = ends
        self.directions = directions


class Relay:
    """Relay for all links of a configuration. Raises NetworkError or OSError if a link cannot be opened."""

    def __init__(self, config: NetworkConfig, *, control: Path | None = None) -> None:
        """Open the links; `control`: local datagram socket for changes, one JSON object each (see `change`)."""
        self.links: dict[str, Link] = {}
        self._waiting: list[tuple[int, int, Link, Packet]] = []
        self._waiting_bytes = 0
        self._order = 0
        self._begin_ns = time.monotonic_ns()
        self._control: socket.socket | None = None
        self._path = control
        try:
            for link in config.links:
                tag = zlib.crc32(link.name.encode())
                ways = (Direction(link.there, (config.seed, tag, 0)), Direction(link.back, (config.seed, tag, 1)))
                self.links[link.name] = Link(link.name, open_ends(link), ways)
            if control is not None:
                self._control = _listen(control)
        except BaseException:
            self.close()
            raise

    def run(self, stopped: Callable[[], bool], duration_s: float | None = None) -> None:
        """Relay packets until `stopped()`, checked ten times a second, or for `duration_s`."""
        begin_ns = self._begin_ns = time.monotonic_ns()
        end_ns = None if duration_s is None else begin_ns + round(duration_s * _NS)
        while not stopped() and (end_ns is None or time.monotonic_ns() < end_ns):
            self.turn(_LONGEST_SLEEP_S)

    def turn(self, longest_s: float) -> None:
        """Sleep until a packet arrives or is due, at most `longest_s`, and process it."""
        now_ns = time.monotonic_ns()
        sleep_s = longest_s
        if self._waiting:
            sleep_s = min(longest_s, max((self._waiting[0][0] - now_ns) / _NS, 0.0))
        poller = select.poll()
        owners: dict[int, Link | None] = {}
        for link in self.links.values():
            for source in link.ends.sources():
                owners[source] = link
        if self._control is not None:
            owners[self._control.fileno()] = None
        for descriptor in owners:
            poller.register(descriptor, select.POLLIN)
        # Rounded up to whole milliseconds, because waking too early would spin.
        ready = poller.poll(-int(-sleep_s * 1000 // 1)) if sleep_s > 0 else poller.poll(0)
        for descriptor, _ in ready:
            owner = owners[descriptor]
            if owner is None:
                self._listen_to_changes()
            else:
                for packet in owner.ends.take(descriptor):
                    self._accept(owner, packet)
        self._deliver(time.monotonic_ns())

    def _accept(self, link: Link, packet: Packet) -> None:
        now_ns = time.monotonic_ns()
        direction = link.directions[0 if packet[0] == LEFT else 1]
        size_bytes = len(packet[1])
        for due_s in direction.offer(size_bytes, (now_ns - self._begin_ns) / _NS):
            if len(self._waiting) >= _MAX_WAITING or self._waiting_bytes + size_bytes > _MAX_WAITING_BYTES:
                direction.tally.queue_full += 1
                return
            self._waiting_bytes += size_bytes
            self._order += 1
            heapq.heappush(self._waiting, (self._begin_ns + round(due_s * _NS), self._order, link, packet))

    def _deliver(self, now_ns: int) -> None:
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, link, packet = heapq.heappop(self._waiting)
            self._waiting_bytes -= len(packet[1])
            link.ends.give(packet)

    def _listen_to_changes(self) -> None:
        assert self._control is not None
        with contextlib.suppress(BlockingIOError):
            data, sender = self._control.recvfrom(_MAX_LINE_BYTES + 1)
            try:
                answer = self.change(data)
            except NetworkError as error:
                answer = {"error": str(error)}
            if sender:
                with contextlib.suppress(OSError):  # the sender has closed its socket
                    self._control.sendto(json.dumps(answer).encode(), sender)

    def change(self, line: bytes) -> dict[str, Any]:
        """Apply {"link": NAME, "cut": true|false} or {"link": NAME, "there": {...}, "back": {...}}; NAME *: all links.

        A named direction gets the given impairment; omitted keys are reset to the perfect default. Raises NetworkError.
        """
        try:
            table = json.loads(line)
        except (ValueError, RecursionError):
            table = None
        if not isinstance(table, dict) or set(table) - {"link", "cut", "there", "back"}:
            raise NetworkError(f"expected an object with link, cut, there, back, found {line[:60]!r}")
        name = table.get("link")
        links = (
            list(self.links.values()) if name == "*" else [link for link in self.links.values() if link.name == name]
        )
        if not links:
            raise NetworkError(f"link: expected * or one of {', '.join(self.links)}, found {name!r}")
        cut = table.get("cut")
        if cut is not None and not isinstance(cut, bool):
            raise NetworkError(f"cut: expected true or false, found {cut!r}")
        rules = {}
        for way, index in (("there", 0), ("back", 1)):
            if way in table:
                if not isinstance(table[way], dict):
                    raise NetworkError(f"{way}: expected an object, found {table[way]!r}")
                rules[index] = parse_impairment(way, table[way])
        for link in links:
            for index, direction in enumerate(link.directions):
                direction.cut = direction.cut if cut is None else cut
                direction.impairment = rules.get(index, direction.impairment)
        return {"links": [link.name for link in links], "effect_ns": time.monotonic_ns()}

    def summary(self) -> dict[str, Any]:
        """Return the packet counts of every link and direction."""
        return {
            "links": {
                name: {"there": asdict(link.directions[0].tally), "back": asdict(link.directions[1].tally)}
                for name, link in self.links.items()
            }
        }

    def close(self) -> None:
        """Close all ends and the control socket."""
        for link in self.links.values():
            link.ends.close()
        if self._control is not None and self._path is not None:
            self._control.close()
            self._control = None
            self._path.unlink(missing_ok=True)


def _listen(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    umask = os.umask(0o177)
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise OSError(f"--control {path}: expected a free path for a socket, {error.strerror or error}") from error
    finally:
        os.umask(umask)
    listener.setblocking(False)
    return listener
