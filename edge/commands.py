"""Console scripts. They import what a command needs only when it runs, so that a missing extra is one line."""

from __future__ import annotations

import importlib.util
import sys
from functools import partial
from typing import Final

from edge.core.cli import run_with_extra

COMMANDS: Final = {
    "edge-run": ("edge.run.command", ""),
    "edge-say": ("edge.run.say", ""),
    "edge-install": ("edge.deploy.install", ""),
    "edge-doctor": ("edge.deploy.doctor.command", ""),
    "edge-replay": ("edge.flightlog.replay.command", ""),
    "edge-calib": ("calib.cli", ""),
    "edge-export": ("export.cli", "export"),
    "edge-hil": ("sim_hil.hil.command", "sim"),
    "edge-bench": ("sim_hil.benchmark.cli", "sim"),
    "edge-soak": ("sim_hil.soak.cli", "sim"),
    "edge-train": ("tools.train.cli", "train"),
}
"""Command -> its module and the extra that it needs; `edge-bridge`, which imports nothing of `edge`, is not here."""
ARGUMENTS: Final = {
    "edge-export": "export.arguments",
    "edge-hil": "sim_hil.hil.arguments",
    "edge-bench": "sim_hil.benchmark.arguments",
    "edge-soak": "sim_hil.soak.arguments",
    "edge-train": "tools.train.arguments",
}
"""Command -> module that parses and checks its arguments without loading torch or the simulation.

It has `parser()` and `check(args)`. A command that loads in less than a second is not here.
"""


def run(command: str) -> int:
    """Run a command and return its exit code.

    Without torch, `edge-export verify` checks what needs no torch. Only the page of `edge-replay explain` needs
    more than the robot has.
    """
    module, extra = COMMANDS[command]
    if command == "edge-replay":
        module, extra = replay_module(sys.argv[1:])
    if command == "edge-export" and sys.argv[1:2] == ["verify"] and importlib.util.find_spec("torch") is None:
        module = "edge.deploy.doctor.verify"
    return run_with_extra(command, module, extra, ARGUMENTS.get(command, ""))


def replay_module(arguments: list[str]) -> tuple[str, str]:
    """Return module and extra of `edge-replay` with its sub-commands."""
    with_page = any(each.startswith("--page") for each in arguments)
    if arguments[:1] == ["explain"]:
        return ("tools.report.explain_page", "export") if with_page else ("edge.flightlog.explain.command", "")
    if arguments[:1] == ["video"]:
        return "edge.flightlog.explain.video", ""
    return COMMANDS["edge-replay"]


edge_run = partial(run, "edge-run")
edge_say = partial(run, "edge-say")
edge_install = partial(run, "edge-install")
edge_doctor = partial(run, "edge-doctor")
edge_replay = partial(run, "edge-replay")
edge_calib = partial(run, "edge-calib")
edge_export = partial(run, "edge-export")
edge_hil = partial(run, "edge-hil")
edge_bench = partial(run, "edge-bench")
edge_soak = partial(run, "edge-soak")
edge_train = partial(run, "edge-train")
