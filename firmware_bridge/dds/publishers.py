"""Counts by DDS discovery the publishers of the topics that the bridge trusts or commands.

A robot's DDS is not authenticated: a second publisher of an input topic is another robot or a forger, and another
publisher of commands is a second commander. Discovery shows both before their first sample.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Final

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

from firmware_bridge.dds.bus import Bus

_FEW: Final = 16  # announcements a step
_MOST: Final = 64  # publishers kept; a flood of more must not cost memory or time


class PublisherWatch:
    """Counts other processes' publishers of some topics."""

    def __init__(self, bus: Bus, allowed: Mapping[str, int]) -> None:
        """`allowed`: largest number of publishers of each watched DDS topic."""
        self._own = str(bus.participant.guid)
        self._allowed = dict(allowed)
        self._topics: dict[str, str] = {}  # GUID of a publisher -> topic
        self._flooded = self._unreadable = False
        self._reader: Any = BuiltinDataReader(bus.participant, BuiltinTopicDcpsPublication)

    def surplus(self) -> str | None:
        """Take the waiting announcements; return a line about a topic with too many publishers, else None."""
        for _ in range(_FEW):
            samples: list[Any] | None = None
            with contextlib.suppress(Exception):  # the binding raises no narrower one for a name that is not UTF-8
                samples = self._reader.take(1)
            if samples is None:  # the announcement is gone, so who it was stays unknown
                self._unreadable = True
                continue
            if not samples:
                break
            self._note(samples[0])
        counts = dict.fromkeys(self._allowed, 0)
        for topic in self._topics.values():
            counts[topic] += 1
        if self._flooded:
            return f"more than {_MOST} publishers of the robot's topics; end them, then restart the bridge"
        if self._unreadable:
            return "a publisher whose announcement cannot be read; end that program, then restart the bridge"
        for topic, allowed in self._allowed.items():
            if counts[topic] > allowed:
                return f"{counts[topic]} publishers of {topic}, expected {allowed}"
        return None

    def _note(self, sample: Any) -> None:
        if not sample.sample_info.valid_data:  # this publisher has ended
            self._topics.pop(str(sample.key), None)
        elif str(sample.participant_key) != self._own and sample.topic_name in self._allowed:
            self._flooded = self._flooded or len(self._topics) >= _MOST
            if not self._flooded:
                self._topics[str(sample.key)] = sample.topic_name
