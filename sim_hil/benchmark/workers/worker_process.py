"""Common part of worker processes: single-threaded, ended with the parent.

A worker reads one job from standard input and writes lines of JSON to a descriptor, because libraries print to standard
output.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import cv2

from firmware_bridge.system.terminal import CommandParser
from sim_hil.processes.child_process import Message, end_with_parent, write_message

Send = Callable[[Mapping[str, Any]], None]

SINGLE_THREADED: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of every worker: one core each, and sums in one order."""


@contextmanager
def line_to_parent(prog: str, argv: Sequence[str] | None = None) -> Iterator[Send]:
    """Become the worker that the command line describes; yields a function that sends one message to the parent."""
    parser = CommandParser(prog=prog)
    parser.add_argument("--fd", type=int, required=True, metavar="N", help="descriptor that lines are written to")
    parser.add_argument("--parent", type=int, required=True, metavar="PID", help="end with this process")
    args = parser.parse_args(argv)
    end_with_parent(args.parent)
    cv2.setNumThreads(1)
    with os.fdopen(args.fd, "w", encoding="utf-8") as lines:
        yield partial(write_message, lines)


def worker_main(prog: str, messages: Callable[[Message], Iterable[Mapping[str, object]]]) -> int:
    """Run the job from standard input and send each of its messages; returns 0."""
    with line_to_parent(prog) as send:
        for message in messages(json.loads(sys.stdin.read())):
            send(message)
    return 0
