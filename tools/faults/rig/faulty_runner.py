"""Runs edge-run with a plan that keeps the robot moving, and with internal faults that can be switched on.

    python -m tools.faults.rig.faulty_runner SOCKET --artifacts DIR --robot FILE.toml --instruction TEXT ...

The product has no hook for faults: this program replaces methods in its own process and then calls the unchanged
`edge.run.command.main` with the arguments after SOCKET. It also replaces the plan of `Policy.act` (`circle.py`) and the
language model's text, so that untrained weights behave like trained ones. Both networks still run.
"""

from __future__ import annotations

import errno
import inspect
import itertools
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.flightlog.part import PartFile
from edge.inference.graph import GraphError
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.run import command as runner
from edge.run import session
from edge.state.reasoning_text import format_waypoints
from tools.faults.rig import circle
from tools.faults.rig.switches import Switches

STEP_S = 0.1
# Untrained weights write no waypoints, and a text without waypoints is a fault.
VALID_TEXT = format_waypoints(((1.0, 0.0), (2.0, 0.0), (3.0, 0.0)))
_RIPPLE_RAD_PER_CALL = 0.7
_HANG_POLL_S = 0.02

FAULTS: Mapping[str, str] = {
    "control-death": "the next call of the action expert raises an unexpected exception",
    "control-hang": "the action expert does not return for seconds_s",
    "tick-slow": "each call of the action expert takes seconds_s longer",
    "act-error": "the action expert's graph fails",
    "encoder-error": "the encoder's graph fails",
    "nan-output": "the plan is not a number",
    "scaled-output": "the plan is `factor` times as long",
    "constant-output": "the plan stays the same",
    "oscillating-output": "the plan turns hard to the other side at every tick",
    "reasoning-death": "the language model raises an unexpected exception",
    "reasoning-hang": "the language model does not return",
    "reasoning-error": "the language model's graph fails",
    "garbage-text": "the language model's answer is the parameter text",
    "disk-full": "the flight log's disk is full",
    "disk-stall": "each write of the flight log takes seconds_s",
    "wall-clock": "the date jumps by seconds_s",
}


class UnexpectedError(Exception):
    """Exception that no code of the runner handles."""


def _trained(original: Callable[..., Any]) -> Callable[..., Any]:
    def load_artifacts(*args: Any, **kwargs: Any) -> Any:
        return replace(original(*args, **kwargs), trained=True)

    return load_artifacts


def _replace(owner: object, name: str, wrapped: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace a function by a wrapper. Raises AttributeError if it does not exist."""
    setattr(owner, name, wrapped(getattr(owner, name)))


def _seconds(values: Mapping[str, Any], default: float) -> float:
    return float(values.get("seconds_s", default))


class Faults:
    """Wraps the runner's methods; `Switches` has the active faults."""

    def __init__(self, switches: Switches) -> None:
        self._on = switches.hit
        self._calls, self._swings = itertools.count(), itertools.count()
        self._held: NDArray[np.float32] | None = None

    def install(self) -> None:
        """Replace the methods, for this process only; those of the graphs once the self-test has proven them."""
        _replace(session, "open_proven", self._open)
        _replace(runner, "load_artifacts", _trained)
        _replace(PartFile, "write", self._disk)
        _replace(PartFile, "sync", self._disk)
        time.time = self._clock(time.time)  # noqa: TID251 - a jump of the date must have no effect

    def _open(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def open_proven(*args: Any, **kwargs: Any) -> Any:
            opened = original(*args, **kwargs)
            _replace(Policy, "act", self._act)
            _replace(Policy, "encode", self._encode)
            _replace(LanguageModel, "run", self._language)
            _replace(LanguageModel, "text_of", self._text)
            return opened

        return open_proven

    def _act(self, original: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(original)

        def act(*args: Any, **kwargs: Any) -> Any:
            self._fail("control-death", UnexpectedError("injected: the control thread dies"))
            for fault, default in (("control-hang", 3600.0), ("tick-slow", 0.3)):
                values = self._on(fault)
                if values is not None:
                    time.sleep(_seconds(values, default))
            self._fail("act-error", GraphError("injected: the action expert's graph fails"))
            real = original(*args, **kwargs)
            given = signature.bind(*args, **kwargs).arguments
            pose: SE2 = given["semantic"].T_odom_anchor @ given["offset"]
            return self._spoiled(circle.plan(pose, len(real), STEP_S, _RIPPLE_RAD_PER_CALL * next(self._calls)))

        return act

    def _spoiled(self, plan: Any) -> Any:
        if self._on("constant-output") is not None:
            if self._held is None:
                self._held = plan
            plan = self._held
        else:
            self._held = None
        if self._on("oscillating-output") is not None:
            side = 1.0 if next(self._swings) % 2 else -1.0
            plan = plan * np.array([1.0, 0.0, 0.0], dtype=np.float32)
            plan[:, 1] = side * plan[:, 0]
            plan[:, 2] = side * np.linspace(0.0, 1.5, len(plan), dtype=np.float32)
        values = self._on("scaled-output")
        if values is not None:
            plan = plan * np.float32(values.get("factor", 10.0))
        if self._on("nan-output") is not None:
            plan = np.full_like(plan, np.nan)
        return plan

    def _encode(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def encode(*args: Any, **kwargs: Any) -> Any:
            self._fail("encoder-error", GraphError("injected: the encoder's graph fails"))
            return original(*args, **kwargs)

        return encode

    def _fail(self, fault: str, error: Exception) -> None:
        if self._on(fault) is not None:
            raise error

    def _language(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            self._fail("reasoning-death", UnexpectedError("injected: the reasoning thread dies"))
            while self._on("reasoning-hang") is not None:
                time.sleep(_HANG_POLL_S)
            self._fail("reasoning-error", GraphError("injected: the language model's graph fails"))
            return original(*args, **kwargs)

        return run

    def _text(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def text_of(*args: Any, **kwargs: Any) -> Any:
            original(*args, **kwargs)
            values = self._on("garbage-text")
            return VALID_TEXT if values is None else str(values.get("text", "__import__('os').system('true')"))

        return text_of

    def _disk(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def touch(*args: Any, **kwargs: Any) -> Any:
            self._fail("disk-full", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
            values = self._on("disk-stall")
            if values is not None:
                time.sleep(_seconds(values, 5.0))
            return original(*args, **kwargs)

        return touch

    def _clock(self, original: Callable[[], float]) -> Callable[[], float]:
        def now() -> float:
            values = self._on("wall-clock")
            return original() + (0.0 if values is None else _seconds(values, 3600.0))

        return now


def main(argv: list[str] | None = None) -> int:
    """Install the faults and run edge-run."""
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments or arguments[0].startswith("-"):
        sys.stderr.write("faulty_runner: expected a path for the fault socket, then the arguments of edge-run\n")
        return 2
    threading.current_thread().name = "main"
    Faults(Switches(Path(arguments[0]), FAULTS)).install()
    return runner.main(arguments[1:])


if __name__ == "__main__":
    sys.exit(main())
