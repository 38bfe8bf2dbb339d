"""Common part of worker processes: single-threaded, ended with the parent.

A worker reads one job from standard input and writes lines of JSON to a descriptor, because libraries print to standard
output.
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
"""Environment of every worker: one core each, and a fixed order of sums."""
_PR_SET_PDEATHSIG = 1


def end_with_parent(parent_pid: int) -> None:
    """Let the kernel kill this process when its parent ends for any reason."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)  # the parent has already ended


@contextmanager
def line_to_parent(prog: str, argv: Sequence[str] | None = None) -> Iterator[Tell]:
    """Set up a worker from its command line; yield a function that sends one message to the parent."""
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
    """Run the job from standard input and send its messages to the parent; return 0."""
    with line_to_parent(prog) as tell:
        for message in messages(json.loads(sys.stdin.read())):
            tell(message)
    return 0
