"""Runs a command of the product in this process and logs its memory from inside.

    python -m tools.memory.probe FILE.jsonl PERIOD_S TRACE MODULE ARGUMENTS...

Writes one reading (`gauge.read_own`) every PERIOD_S seconds. With TRACE above 0, tracemalloc keeps so many frames,
and the lines that have grown most since the first minute go to FILE.trace once a minute; that slows the command.
"""

from __future__ import annotations

import json
import runpy
import sys
import threading
import time
import tracemalloc
from pathlib import Path

from tools.memory.gauge import read_own

_FIRST_TRACE_S = 60.0
_TRACE_PERIOD_S = 60.0
_LINES = 30


def _log(file: Path, period_s: float, frames: int) -> None:
    started = time.monotonic()
    first: tracemalloc.Snapshot | None = None
    traced = started
    with file.open("w", encoding="ascii") as stream:
        while True:
            time.sleep(period_s)
            stream.write(json.dumps(read_own()) + "\n")
            stream.flush()
            if frames and time.monotonic() - max(traced, started + _FIRST_TRACE_S) >= 0:
                traced = time.monotonic() + _TRACE_PERIOD_S
                snapshot = tracemalloc.take_snapshot()
                if first is not None:
                    grown = snapshot.compare_to(first, "lineno")[:_LINES]
                    file.with_suffix(".trace").write_text("\n".join(map(str, grown)) + "\n", encoding="utf-8")
                first = first or snapshot


def main(arguments: list[str]) -> None:
    """Start the log and run the command."""
    file, period_s, frames, module, *rest = arguments
    if int(frames):
        tracemalloc.start(int(frames))
    log = threading.Thread(target=_log, args=(Path(file), float(period_s), int(frames)), name="memory", daemon=True)
    log.start()
    sys.argv = [module, *rest]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])
