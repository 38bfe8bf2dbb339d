"""A stand-in for a runtime's worker: `python -m tests.support.benchmark.fake_worker MOOD`."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping

from tools.bench.peers.workers.serve import Load, Task, language_task, serve

MOOD = sys.argv[1] if len(sys.argv) > 1 else "ok"


def load(request: Load) -> Mapping[str, Task]:
    """Tasks that cost nothing, or what the mood says."""
    if MOOD == "refuses":
        raise ValueError("no such form\nand a second line")
    held = bytearray(64_000_000) if MOOD == "large" else bytearray(1)
    print("a library talks on standard output")  # noqa: T201 - that is what the protocol has to survive
    calls = iter(range(1000))

    def encoder() -> dict[str, float]:
        if MOOD == "dies":
            sys.exit(3)
        if MOOD == "fails-later" and next(calls) > 0:
            raise RuntimeError("out of luck")
        held[0] = 1
        return {"encoder_ms": 5.0}

    language = language_task(lambda: 7, lambda token: token + 1, 3)
    return {"encoder": encoder, "language": language, "slow": lambda: (time.sleep(0.05), {"slow_ms": 50.0})[1]}


if __name__ == "__main__":
    sys.exit(serve(load, ("numpy",)))
