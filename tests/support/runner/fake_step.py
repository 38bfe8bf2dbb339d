"""Stands in for one command of the demo: `python fake_step.py ROLE MOOD ARGUMENTS...` behaves as the real one would.

Moods: ok · fails (prints three lines and exits 1) · early (ends while others still need it) · deaf (ignores SIGINT) ·
slow (never gets ready or never ends by itself) · faulty (a runner that a fault ended: result, flight log and exit 1).
"""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))  # so that this script finds its neighbour

DURATION_S = 6.0


def value(name: str) -> str:
    return sys.argv[sys.argv.index(name) + 1]


def wait_for_interrupt(mood: str) -> None:
    if mood == "deaf":
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            time.sleep(0.02)
    except KeyboardInterrupt:
        return


def export(mood: str) -> None:
    if "verify" in sys.argv:
        sys.exit(0 if mood == "ok" else 1)
    out = Path(value("--out"))
    out.mkdir(parents=True)
    (out / "manifest.json").write_text(json.dumps({"model": {"trained": False}}))
    Path(value("--json")).write_text(json.dumps({"target": value("--target")}))


def hil(mood: str) -> None:
    from tests.support.runner import synthetic_run

    lines = synthetic_run.trace_lines(DURATION_S)
    Path(value("--trace")).write_text("".join(json.dumps(line) + "\n" for line in lines))
    if mood == "slow":
        time.sleep(60)
    sys.stderr.write(f"edge-hil: ready, {[each for each in sys.argv if 'domain' in each]}\n")
    sys.stderr.flush()
    if mood == "early":
        time.sleep(0.4)
        sys.exit(7)
    wait_for_interrupt(mood)
    Path(value("--json")).write_text(json.dumps(synthetic_run.hil_result(DURATION_S)))


def bridge(mood: str) -> None:
    from tests.support.runner import synthetic_run

    Path(tomllib.loads(Path(value("--robot")).read_text())["bridge"]["socket"]).touch()
    wait_for_interrupt(mood)
    Path(value("--json")).write_text(json.dumps(synthetic_run.bridge_result(DURATION_S)))


def run(mood: str) -> None:
    if mood in ("slow", "deaf"):
        wait_for_interrupt(mood)
        sys.exit(130)
    from tests.support.runner import synthetic_run

    synthetic_run.write_flight_log(Path(value("--record")), DURATION_S)
    faults = ["the bridge stopped the robot"] if mood == "faulty" else []
    Path(value("--json")).write_text(json.dumps({**synthetic_run.run_result(DURATION_S), "faults": faults}))
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    role, mood = sys.argv[1:3]
    sys.stderr.write(f"{role} started\n")
    if mood == "fails":
        sys.stderr.write("first line\nthe reason is here\n")
        sys.exit(1)
    {"export": export, "hil": hil, "bridge": bridge, "run": run}[role](mood)
