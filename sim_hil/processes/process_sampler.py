"""Samples memory, descriptors and processor time of processes."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import psutil

PSS_EVERY: Final = 10
"""Samples between two readings of PSS, which takes milliseconds because the kernel sums it page by page."""


class ProcessSampler:
    """Sampler of processes by name; ended processes are left out."""

    def __init__(self) -> None:
        self._known: dict[int, psutil.Process] = {}
        self._count = 0

    def sample(self, pids: Mapping[str, int]) -> dict[str, dict[str, Any]]:
        """Return by name: pid, cpu_percent since the last sample, rss_bytes, fds, threads, sometimes pss_bytes."""
        self._count += 1
        found: dict[str, dict[str, Any]] = {}
        for name, pid in pids.items():
            with suppress(psutil.Error):
                found[name] = self._one(pid)
        self._known = {pid: process for pid, process in self._known.items() if pid in pids.values()}
        return found

    def _one(self, pid: int) -> dict[str, Any]:
        process = self._known.get(pid)
        if process is None:
            process = self._known[pid] = psutil.Process(pid)
            process.cpu_percent()  # the first call only sets the reference
        with process.oneshot():
            values: dict[str, Any] = {
                "pid": pid,
                "cpu_percent": process.cpu_percent(),
                "rss_bytes": process.memory_info().rss,
                "fds": process.num_fds(),
                "threads": process.num_threads(),
            }
        if self._count % PSS_EVERY == 1:
            with suppress(psutil.Error):
                values["pss_bytes"] = process.memory_full_info().pss
        return values
