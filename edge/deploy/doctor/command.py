"""`edge-doctor`: checks this machine, the artifacts and the link to the robot, and advises what to do."""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.artifacts.target_facts import PlanFacts, TargetFacts, plan_facts, target_facts
from edge.artifacts.trust import STATE_DIRECTORY
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from edge.core.device import available_providers, package_version
from edge.deploy.doctor import link as doctor_link
from edge.deploy.doctor import machine as doctor_machine
from edge.deploy.doctor import rights as doctor_rights
from edge.deploy.doctor import robot as doctor_robot
from edge.deploy.doctor import runtime as doctor_runtime
from edge.deploy.doctor import topics as doctor_topics
from edge.deploy.doctor.check import Check, Level, failed, skipped, table
from edge.deploy.doctor.rights import UserRights, user_named
from edge.deploy.unit_check import run_command
from edge.inference import engines
from edge.inference.graph import GraphError
from edge.power.governor.plan import PowerPlan, read_power_plan
from edge.power.meters.select import open_meter
from firmware_bridge.core.config import ConfigError, RobotConfig, load_robot_config
from firmware_bridge.system.terminal import CommandParser

if TYPE_CHECKING:
    from edge.inference.warm_up import Opened  # needs ONNX Runtime

EXAMPLES = """examples:
  edge-doctor --artifacts out/orin --robot go2.toml
  edge-doctor --artifacts out/orin --target orin --json -
  sudo edge-doctor --artifacts /opt/tic-vla-edge/current/artifacts --robot /etc/tic-vla-edge/go2.toml \\
       --socket /run/tic-vla-edge/bridge.sock --user tic-vla-runner
  edge-doctor

Checks without their option are skipped. It opens the graphs and runs ticks on a black picture; it reads the state of
the bridge and the robot and one picture, and never commands anything.
exit codes: 0 no check failed (warnings may have been given), 1 a check failed, 2 bad arguments, 130 interrupted
"""
TICKS = 100
TICK_BUDGET_S = 20.0
SETTLE_S = 0.5
"""Time between two readings of other programs' processor use."""
ROOT = Path("/")
T = TypeVar("T")


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-doctor`."""
    p = CommandParser(
        "edge-doctor", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--artifacts", type=Path, metavar="DIR", help="directory made by edge-export")
    p.add_argument("--robot", type=Path, metavar="FILE.toml", help="the robot and its limits")
    p.add_argument("--target", metavar="NAME", help="fail if the artifacts are made for any other target")
    p.add_argument("--engines", type=Path, metavar="DIR", help="engines (default: ARTIFACTS.engines)")
    p.add_argument("--socket", type=Path, metavar="PATH", help="socket of edge-bridge (default: the robot file's)")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: the robot file's)")
    p.add_argument("--logs", type=Path, metavar="DIR", help=f"flight logs' folder (default: {STATE_DIRECTORY} or .)")
    p.add_argument("--user", metavar="NAME", help="user whose rights are checked, e.g. the service's (default: you)")
    p.add_argument("--ticks", type=int, default=TICKS, metavar="N", help=f"ticks to time (default: {TICKS}; 0: none)")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line("edge-doctor", {OSError: EXIT_BAD_INPUT, ConfigError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    check_result_target(args.json)
    if args.ticks < 0:
        raise ConfigError(f"--ticks {args.ticks}: expected 0 or more")
    checks = list(examine(args))
    # With `--json -` standard output carries the JSON only, without the table.
    Console(stderr=args.json == "-").print(table(checks))
    counts = {level.value: sum(check.level is level for check in checks) for level in Level}
    wall_s = round((time.monotonic_ns() - started_ns) / 1e9, 3)
    numbers = ", ".join(f"{number} {level}" for level, number in counts.items())
    messages("edge-doctor")(f"{numbers} in {wall_s:.1f} s")
    result: dict[str, Any] = {"ok": not failed(checks), "counts": counts, "wall_s": wall_s}
    result["checks"] = [check.to_dict() for check in checks]
    write_result(args.json, result)
    return EXIT_CHECK_FAILED if failed(checks) else EXIT_DONE


def examine(args: argparse.Namespace, root: Path = ROOT) -> Iterator[Check]:
    """Run every check, in the order of the table; `root`: root folder of Linux's files."""
    user = user_named(args.user)
    # Before this program computes.
    busy = _busy(root / "proc")
    robot, robot_check = _robot(args)
    loaded, artifact_check = _artifacts(args)
    yield artifact_check
    facts: TargetFacts | None = None
    plan: PlanFacts | None = None
    power: PowerPlan | None = None
    refused: list[Check] = []
    if loaded is not None:
        artifacts = loaded
        facts = _read_facts(refused, "target in the manifest", lambda: target_facts(read_manifest(artifacts.directory)))
        plan = _read_facts(refused, "plan in the manifest", lambda: plan_facts(read_manifest(artifacts.directory)))
        power = _read_facts(refused, "power plan in the manifest", lambda: read_power_plan(artifacts))
    yield from refused
    yield from _machine(args, root, loaded, facts, plan)
    yield busy
    yield from _rights(root, loaded, power, robot, user)
    yield from _graphs(args, loaded, plan)
    yield robot_check
    if robot is not None:
        yield from doctor_link.robot_links(robot, root, user)
        if robot.ros2 is not None:
            yield from doctor_topics.ros2_topics(robot)
        yield doctor_robot.bridge(robot)
        yield from doctor_robot.robot_link(robot, 448 if loaded is None else loaded.runtime.image_px)


def _read_facts(refused: list[Check], name: str, read: Callable[[], T]) -> T | None:
    """Return a fact of the manifest; None, and a failed check in `refused`, where the manifest is malformed."""
    try:
        return read()
    except ArtifactError as error:
        refused.append(Check(name, Level.FAIL, str(error), "what edge-export writes", "export the artifacts again"))
        return None


def _robot(args: argparse.Namespace) -> tuple[RobotConfig | None, Check]:
    name = "robot file"
    if args.robot is None:
        return None, skipped(name, "no --robot, so neither bridge, robot nor camera is checked")
    try:
        robot = load_robot_config(args.robot, socket=args.socket, domain=args.domain)
    except ConfigError as error:
        return None, Check(name, Level.FAIL, str(error), "a robot file", "correct the key that the message names")
    return robot, Check(name, Level.OK, f"{robot.name}, {robot.protocol}")


def _artifacts(args: argparse.Namespace) -> tuple[Artifacts | None, Check]:
    name = "artifacts"
    if args.artifacts is None:
        return None, skipped(name, "no --artifacts, so nothing is compared with a target or its plan")
    try:
        artifacts = load_artifacts(args.artifacts.absolute())
    except (ArtifactError, OSError) as error:
        return None, Check(name, Level.FAIL, str(error), "a whole directory", "export or copy the artifacts again")
    found = f"{artifacts.model_name} for {artifacts.target}, {len(artifacts.graphs)} graphs, every file verified"
    if args.target is not None and artifacts.target != args.target:
        return artifacts, Check(name, Level.FAIL, found, args.target, f"edge-export --target {args.target}")
    trained = "" if artifacts.trained else "; untrained weights"
    return artifacts, Check(name, Level.OK, found + trained, args.target or "")


def _machine(
    args: argparse.Namespace, root: Path, artifacts: Artifacts | None, facts: TargetFacts | None, plan: PlanFacts | None
) -> Iterator[Check]:
    wanted = sorted({graph.session.provider for graph in artifacts.graphs.values()}) if artifacts is not None else []
    yield doctor_runtime.onnx_runtime(wanted, available_providers(), package_version, platform.machine(), root)
    if artifacts is None or facts is None:
        yield skipped("target", "the artifacts name none" if artifacts is not None else "no artifacts")
        yield skipped("power mode", "no target")
    else:
        yield doctor_machine.match(facts, wanted, platform.machine(), available_providers(), root)
        yield doctor_machine.power_mode(facts.power_mode, root, _nvpmodel)
        yield doctor_machine.boot_power_mode(facts.power_mode, root)
    yield doctor_machine.hardware_watchdog(root)
    yield doctor_machine.clocks(root)
    yield doctor_machine.cpu_governor(root)
    yield doctor_machine.memory(plan, root, own_memory=facts is not None and facts.own_memory)
    logs = args.logs or (STATE_DIRECTORY if STATE_DIRECTORY.is_dir() else Path())
    yield doctor_machine.disk(logs.absolute(), _disk_usage)
    utc = datetime.timezone.utc
    written_s = 0.0 if artifacts is None else (artifacts.directory / MANIFEST_NAME).stat().st_mtime
    # A file system stores years that `datetime` cannot represent.
    latest_s = datetime.datetime(9999, 1, 1, tzinfo=utc).timestamp()
    made = datetime.datetime.fromtimestamp(min(max(written_s, 0.0), latest_s), utc)
    yield doctor_machine.wall_clock(datetime.datetime.now(utc), made, root)


def _nvpmodel() -> str | None:
    tool = shutil.which("nvpmodel")
    if tool is None:
        return None
    try:
        return run_command([tool, "-q"])[1]
    except (OSError, subprocess.TimeoutExpired):
        return None


def _disk_usage(folder: Path) -> tuple[int, int]:
    usage = shutil.disk_usage(folder)
    return usage.free, usage.total


def _busy(proc: Path) -> Check:
    before, started_ns = doctor_machine.processor_ticks(proc), time.monotonic_ns()
    time.sleep(SETTLE_S)
    after = doctor_machine.processor_ticks(proc)
    ticks = (time.monotonic_ns() - started_ns) / 1e9 * os.sysconf("SC_CLK_TCK")
    return doctor_machine.busy_programs(before, after, ticks, os.getpid())


def _rights(
    root: Path, artifacts: Artifacts | None, power: PowerPlan | None, robot: RobotConfig | None, user: UserRights
) -> Iterator[Check]:
    if artifacts is None:
        yield skipped("real-time priority", "no artifacts")
        yield skipped("device nodes", "no artifacts")
    else:
        yield doctor_rights.real_time(artifacts.runtime.control_priority, user)
        providers = sorted({graph.session.provider for graph in artifacts.graphs.values()})
        yield doctor_rights.device_access(providers, root, user)
    yield doctor_rights.locked_memory(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], user)
    if robot is not None:
        yield doctor_rights.socket_folder(robot.bridge.socket, user)
    kind, rail = ("auto", None) if power is None else (power.meter, power.rail)
    sysfs = root / "sys"
    yield doctor_rights.power_meter(kind, lambda: open_meter(kind, sysfs_root=sysfs, rail=rail), sysfs, user)
    yield doctor_rights.temperatures(root / "sys", time.monotonic_ns())


def _graphs(args: argparse.Namespace, artifacts: Artifacts | None, plan: PlanFacts | None) -> Iterator[Check]:
    if artifacts is None:
        for name in ("self-test", "providers of the graphs", "tick"):
            yield skipped(name, "no artifacts")
        return
    if engines.needed(artifacts):
        folder = (args.engines or engines.default_directory(artifacts.directory)).absolute()
        try:
            engines.check(artifacts, folder)
        except engines.EngineError as error:
            problem, _, advice = str(error).rpartition("; build it first: ")
            yield Check("engines", Level.FAIL, problem or advice, "this device's own", advice)
            for name in ("self-test", "providers of the graphs", "tick"):
                yield skipped(name, "an engine would be built now, for minutes")
            return
        yield Check("engines", Level.OK, f"{folder}: this device's own")
        artifacts = engines.with_engines(artifacts, folder)
    from edge.deploy.doctor import graphs as doctor_graphs  # needs ONNX Runtime

    tested, opened = doctor_graphs.self_test(artifacts)
    yield tested
    if opened is None:
        for name in ("providers of the graphs", "tick"):
            yield skipped(name, "the self-test failed")
        return
    placed = [doctor_graphs.profile_graph(artifacts, name, opened.guard) for name in artifacts.graphs]
    yield from placed
    if failed(placed):
        yield skipped("tick", "a graph does not run as it should")
    elif args.ticks == 0:
        yield skipped("tick", "--ticks 0")
    else:
        yield _tick(args, opened, plan)


def _tick(args: argparse.Namespace, opened: Opened, plan: PlanFacts | None) -> Check:
    from edge.deploy.doctor import graphs as doctor_graphs  # needs ONNX Runtime
    from edge.inference.start_guard import WARM_UP_S

    policy = opened.policy
    runtime = policy.artifacts.runtime
    prompt = min(runtime.frame_tokens if plan is None else plan.prompt_tokens, runtime.max_context)
    try:
        with opened.guard.stage("ticks", WARM_UP_S):
            times_ms = doctor_graphs.measure_ticks(policy, args.ticks, TICK_BUDGET_S, prompt)
    except (GraphError, ArtifactError) as error:
        return Check("tick", Level.FAIL, str(error), "a tick that runs", "edge-export verify DIR names what is wrong")
    return doctor_graphs.judge_ticks(times_ms, plan, runtime.tick_period_ms)


if __name__ == "__main__":
    sys.exit(main())
