"""Injections of faults at a control loop's inputs, and how long the loop takes to answer them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edge.safety.faults.findings import Finding
from edge.safety.faults.table import FAULTS
from tests.support.runner.control_bench import MS, PERIOD_NS, PX, Attitude, Bench

BRIDGE_NS = 20 * MS
"""One period of the bridge: from a command's arrival to the wire."""
FULL, HALF = 0.8, 0.4

Inject = Callable[[Bench], object]
"""Changes what the next tick finds."""


def driving() -> Bench:
    """Return a bench that drives at the speed limit, so that half speed can be seen."""
    bench = Bench()
    bench.policy.step = (0.1, 0.0, 0.0)
    bench.see()
    bench.think()
    for _ in range(25):
        bench.see()
        speed, reason = bench.tick()
        bench.think(1)
    assert (speed, reason) == (FULL, "ok")
    return bench


def found(bench: Bench, name: str) -> bool:
    return name in bench.loop.supervision.active


def until(bench: Bench, name: str, inject: Inject, *, between_ticks: bool = False) -> float:
    """Inject in every tick until the fault is active; ms from the injection to the command that followed, at worst.

    The worst case is a fault that begins just after a tick has looked: a whole period is added to what the ticks show.
    """
    began_ns = bench.now_ns
    for _ in range(400):
        inject(bench)
        if between_ticks:
            bench.loop.poll_urgent_faults()
            if found(bench, name):
                return (bench.sink.stamps_ns[-1] - began_ns) / MS + 10
        bench.tick()
        if found(bench, name):
            return (bench.sink.stamps_ns[-1] - began_ns + PERIOD_NS) / MS
    raise AssertionError(f"{name} was never found: {bench.loop.supervision}")


def check_zero_in_time(bench: Bench, name: str, inject: Inject, *, between_ticks: bool = False) -> None:
    took_ms = until(bench, name, inject, between_ticks=between_ticks)
    assert took_ms + BRIDGE_NS / MS <= FAULTS[name].bound_ms
    assert bench.sink.commands[-1][1:] == (0.0, 0.0)
    assert bench.loop.supervision.stop == FAULTS[name].latch


def drives_again(bench: Bench, ticks: int = 40) -> bool:
    """Whether the robot drives at full speed once everything is well again."""
    bench.policy.blind = bench.policy.constant = False
    bench.policy.step = (0.1, 0.0, 0.0)
    bench.jpeg, bench.attitude, bench.encode_ns = b"", Attitude(), 0
    for _ in range(ticks):
        bench.see()
        bench.think(2)
        speed, reason = bench.tick()
    return (speed, reason) == (FULL, "ok")


# Injections


def changed(**values: object) -> Inject:
    """A new picture and pose, and these attributes of the bench or, after a dot, of one of its parts."""

    def inject(bench: Bench) -> None:
        bench.see()
        for name, value in values.items():
            part, _, attribute = name.rpartition("__")
            setattr(getattr(bench, part) if part else bench, attribute, value)

    return inject


def counted(name: str) -> Inject:
    """A new picture and pose, and one more of what a counter of the bench counts."""

    def inject(bench: Bench) -> None:
        bench.see()
        setattr(bench, name, getattr(bench, name) + 1)

    return inject


def reported(name: str) -> Inject:
    """What another thread reports in each of its steps."""

    def inject(bench: Bench) -> None:
        bench.see()
        bench.findings.put((Finding(name),))

    return inject


def pictures_aged(age_ms: float) -> Inject:
    def inject(bench: Bench) -> None:
        bench.feel()
        bench.look(age_ms=age_ms)

    return inject


def every(nth: int) -> Inject:
    """Only every `nth` picture arrives."""

    def inject(bench: Bench) -> None:
        bench.feel()
        if round(bench.now_ns / PERIOD_NS) % nth == 0:
            bench.look()

    return inject


def jpeg(width: int, height: int) -> bytes:
    """Enough of a JPEG for its size to be read."""
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc0\x00\x11\x08" + size + b"\x03" + bytes(20) + b"\xff\xd9"


def bad_picture(kind: str) -> Inject:
    shape = (1, PX // 2 if kind == "small" else PX, PX, 3)

    def inject(bench: Bench) -> None:
        bench.feel()
        bench.jpeg = jpeg(64, 48)[:-2] if kind == "torn" else b""
        grey = {"black": 0, "saturated": 255}.get(kind, 99)
        bench.look(None if kind == "torn" else np.full(shape, grey, dtype=np.uint8))

    return inject


def another_camera(bench: Bench) -> None:
    size = (640, 480) if bench.jpeg else (1280, 720)
    bench.see()
    bench.jpeg = jpeg(*size)
    bench.look()


def repeated(count: int) -> Inject:
    """The same pictures in turn while the robot moves."""
    stale: list[np.ndarray] = []

    def inject(bench: Bench) -> None:
        if not stale:
            stale.extend(bench.picture() for _ in range(count))
        stale.append(stale.pop(0))
        bench.feel()
        bench.look(stale[-1])

    return inject


def with_clock() -> Inject:
    """A picture in which only a clock changes, at the speed limit: the scene must change within 0.2 m."""
    frozen: list[np.ndarray] = []

    def inject(bench: Bench) -> None:
        if not frozen:
            frozen.append(bench.picture())
        picture = frozen[0].copy()
        picture[0, 2:5, 4:16] = bench.picture()[0, 2:5, 4:16]
        bench.feel(bench.walked_m + 0.1 * FULL)
        bench.look(picture)

    return inject
