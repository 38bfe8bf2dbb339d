"""Worker process of one episode: reads a task, writes progress and one result as lines of JSON."""

from __future__ import annotations

import json
import sys
import time

from edge.artifacts.files import ArtifactError
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_REFUSED
from edge.reasoning.prompt import InstructionError
from firmware_bridge.core.config import ConfigError
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.policies.external_protocol import ExternalError
from sim_hil.benchmark.suite.episode import SuiteError
from sim_hil.benchmark.workers.run_episode import run_episode
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.benchmark.workers.worker_process import line_to_parent
from sim_hil.scene.scene import SceneError

SEND_EVERY_NS = 500_000_000

_BAD_INPUT = (  # no further attempt can succeed
    ConditionsError,
    SuiteError,
    SceneError,
    ConfigError,
    InstructionError,
)


def main(argv: list[str] | None = None) -> int:
    """Read one task from standard input and run it; exit code 0 once the result or a refusal has been sent."""
    with line_to_parent("python -m sim_hil.benchmark.workers.worker", argv) as send:
        sent_ns = time.monotonic_ns()

        def send_time(time_s: float) -> None:
            nonlocal sent_ns
            if time.monotonic_ns() - sent_ns > SEND_EVERY_NS:
                sent_ns = time.monotonic_ns()
                send({"time_s": time_s})

        try:
            task = EpisodeTask.of_json(json.loads(sys.stdin.read()))
            send({"result": run_episode(task, send_time).as_json()})
        except ArtifactError as error:
            send({"refused": str(error), "code": EXIT_REFUSED})
        except _BAD_INPUT as error:
            send({"refused": str(error), "code": EXIT_BAD_INPUT})
        except ExternalError as error:
            # A policy server that is gone or misbehaves: this run has failed, another attempt may not.
            send({"failed": str(error)})
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
