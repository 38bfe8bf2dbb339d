"""What a worker process is like, apart from what it runs: one core, and no longer alive than its parent.

It reads one job from its standard input and writes lines of JSON to the descriptor that it is given: its standard
output belongs to the libraries (the physics engine prints).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import cv2

Message = dict[str, Any]
Tell = Callable[[Mapping[str, Any]], None]

SINGLE_THREADED: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of every worker: one core each, and sums in one order."""
_PR_SET_PDEATHSIG = 1


def end_with_parent(parent_pid: int) -> None:
    """Let the kernel kill this process when its parent has gone, whatever ended that."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)  # it had gone before


@contextmanager
def line_to_parent(prog: str, argv: Sequence[str] | None = None) -> Iterator[Tell]:
    """Of a worker module: become the worker that the command line says, and tell its parent of one thing at a time."""
    parser = argparse.ArgumentParser(prog=prog)
    parser.add_argument("--fd", type=int, required=True, metavar="N", help="descriptor that lines are written to")
    parser.add_argument("--parent", type=int, required=True, metavar="PID", help="end with this process")
    args = parser.parse_args(argv)
    end_with_parent(args.parent)
    cv2.setNumThreads(1)
    with os.fdopen(args.fd, "w", encoding="utf-8") as lines:

        def tell(message: Mapping[str, object]) -> None:
            lines.write(json.dumps(message) + "\n")
            lines.flush()

        yield tell


def worker_main(prog: str, messages: Callable[[Message], Iterable[Mapping[str, object]]]) -> int:
    """Of a worker module: run the job from standard input, telling each of its messages; returns 0."""
    with line_to_parent(prog) as tell:
        for message in messages(json.loads(sys.stdin.read())):
            tell(message)
    return 0
