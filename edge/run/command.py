"""`edge-run`: drives a robot with a control thread that never waits for the reasoning thread beside it."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import cv2

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.trust import STATE_DIRECTORY, KeyFileError, Trust
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    LONGEST_S,
    OutputError,
    check_result_target,
    command_line,
    write_result,
)
from edge.core.heap import keep_large_blocks_apart
from edge.flightlog.reader import parts
from edge.inference import engines
from edge.inference.release import ReleaseDelayError, parse_release_delay
from edge.live.options import add_live_arguments, live_options
from edge.odometry.calibration import CalibrationError
from edge.reasoning.generation_cycle import Mode
from edge.reasoning.prompt import InstructionError
from edge.robot.arming import RefusedError, StoppedEarlyError
from edge.run.assembly import RunOptions
from edge.run.instructions import check_first_instruction
from edge.run.service import operator_lines
from edge.run.session import RunSession
from edge.state.switches import Decoding, RecoverySwitch, Speculation, SwitchOptions
from firmware_bridge.client import BridgeUnavailable
from firmware_bridge.core.config import ConfigError, RobotConfig, load_robot_config
from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.system.terminal import CommandParser

EXAMPLES = """examples:
  edge-run --artifacts out/nano --robot go2.toml --instruction "walk to the vending machine"
  edge-run --artifacts out/nano --robot firmware_bridge/robots/go2_sim.toml --duration 60 \\
           --release-delay 2 --record flight.mcap --json - --instruction "go down the corridor"
  edge-run --artifacts out/nano --robot go2.toml --instructions say.sock --instruction "go down the corridor"
  edge-say "stop at the second door" --to say.sock      # while it drives; its own user only
  edge-say stop --to say.sock                           # a stop phrase: stops the robot and ends the run
  edge-run --artifacts out/nano --robot go2.toml --live --instruction "go down the corridor"   # prints an address

edge-bridge must be running; where the robot file says operator_arm, the robot stays where it is until
`edge-bridge arm`. Without --duration it drives until SIGINT or SIGTERM; both stop the robot first.
exit codes: 0 done (also after SIGTERM), 1 a fault ended the run, no plan was finite, or the
            result could not be written, 2 bad arguments or input, 3 refused to drive,
            130 interrupted (SIGINT); a hang of control or reasoning that cannot be interrupted ends the process
            by SIGKILL, so that its service starts it again
"""

LINES_S = 1.0
"""How long the terminal may take at the end for what has not been printed yet."""
SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while the control thread wants it (CPython's default is 5 ms)."""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-run`."""
    p = CommandParser(
        "edge-run", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    p.add_argument("--robot", type=Path, required=True, metavar="FILE.toml", help="the robot and its limits")
    p.add_argument("--instruction", required=True, metavar="TEXT", help="what the robot is to do, in plain words")
    p.add_argument(
        "--mode",
        choices=[mode.value for mode in Mode],
        default=Mode.ASYNC.value,
        help="sync: halt during reasoning, then drive 0.5 s; no-reasoning: prefill only (default: async)",
    )
    p.add_argument("--duration", type=float, metavar="S", help="drive for this long (default: until a signal)")
    p.add_argument(
        "--release-delay",
        default="0",
        metavar="S|PROFILE",
        help="hold each finished generation back, as slower hardware would: seconds, or a JSON profile (default: 0)",
    )
    p.add_argument(
        "--engines", type=Path, metavar="DIR", help="engines built by edge-install (default: ARTIFACTS.engines)"
    )
    p.add_argument(
        "--trust",
        type=Path,
        metavar="KEY.pub",
        help="drive only artifacts signed with this key (python -m edge.signature)",
    )
    p.add_argument(
        "--state",
        type=Path,
        default=STATE_DIRECTORY,
        metavar="DIR",
        help="where the newest release that was trusted is remembered (default: %(default)s)",
    )
    p.add_argument(
        "--instructions",
        type=Path,
        metavar="PATH",
        help="take further instructions at this local socket while it drives (edge-say TEXT --to PATH)",
    )
    p.add_argument(
        "--decoding",
        choices=[each.value for each in Decoding],
        help="free: greedy, as in the paper; constrained: within rules (default: the manifest's; usually constrained)",
    )
    p.add_argument(
        "--recovery",
        choices=[each.value for each in RecoverySwitch],
        help="off: only the plan moves the robot (default: the manifest's; usually on)",
    )
    p.add_argument(
        "--speculation",
        choices=[each.value for each in Speculation],
        help="on: verify guessed tokens, faster with the same texts (default: the manifest's; usually on)",
    )
    p.add_argument(
        "--stay",
        action=argparse.BooleanOptionalAction,
        help="stand where the texts have placed the stop (default: with --recovery on)",
    )
    add_live_arguments(p)
    p.add_argument("--record", type=Path, metavar="FILE.mcap", help="write a flight log")
    p.add_argument(
        "--require-operator",
        action="store_true",
        help="refuse a robot file without operator_arm (the installed service, which starts again after a crash)",
    )
    p.add_argument("--socket", type=Path, metavar="PATH", help="socket of edge-bridge (default: the robot file's)")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: the robot file's)")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def read_options(args: argparse.Namespace) -> tuple[RobotConfig, RunOptions]:
    """Everything that can be refused without looking at the robot or the artifacts."""
    if args.duration is not None and not 0 < args.duration <= LONGEST_S:
        raise ConfigError(f"--duration {args.duration}: expected seconds above 0 and up to {LONGEST_S:g} (30 days)")
    check_result_target(args.json)
    if args.record is not None:
        there = [part for part in parts(args.record) if part.exists()]
        if there:
            raise ConfigError(f"--record {there[0]}: exists; a flight log is never overwritten, name another file")
        if not args.record.parent.is_dir():
            raise ConfigError(f"--record {args.record}: there is no directory {args.record.parent}")
        check_result_target(str(args.record), "--record")
    robot = load_robot_config(args.robot, socket=args.socket, domain=args.domain)
    if args.require_operator and not robot.safety.operator_arm:
        raise ConfigError(
            f"robot file {args.robot}: safety.operator_arm: expected true, found false: this service starts again by "
            "itself; set it to true, or install it anew with edge-install units --arm-at-start"
        )
    if robot.ros2_publish.publish and importlib.util.find_spec("cyclonedds") is None:
        raise ModuleNotFoundError("No module named 'cyclonedds'", name="cyclonedds")
    options = RunOptions(
        instruction=check_first_instruction(args.instruction),
        mode=Mode(args.mode),
        duration_s=args.duration,
        release_delay=parse_release_delay(args.release_delay),
        record=args.record,
        instructions=args.instructions,
        live=live_options(args),
        switches=_switches(args),
    )
    return robot, options


def _switches(args: argparse.Namespace) -> SwitchOptions:
    try:
        return SwitchOptions.parse(args.decoding, args.recovery, args.stay, args.speculation)
    except ValueError as error:
        raise ConfigError(str(error)) from error


@command_line("edge-run")
def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    lines = operator_lines("edge-run")
    try:
        sessions: list[RunSession] = []
        code = _run(args, lines.write, sessions)
    finally:
        lines.close(LINES_S)
    if any(session.hung for session in sessions):
        # A thread that hangs in a driver can keep an orderly exit from ending. To systemd a signal is abnormal.
        os.kill(os.getpid(), signal.SIGKILL)
    return code


def _run(args: argparse.Namespace, say: Callable[[str], None], sessions: list[RunSession]) -> int:
    keep_large_blocks_apart()
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    received: list[int] = []

    def on_signal(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        for session in sessions:
            session.request_stop()

    try:
        robot, options = read_options(args)
        trust = None if args.trust is None else Trust(args.trust, args.state / "release.json")
        artifacts = load_artifacts(args.artifacts.absolute(), trust)
        # Before anything moves: a provider without its engine would compile for minutes while the robot drives.
        folder = args.engines or engines.default_directory(artifacts.directory)
        verified = engines.check(artifacts, folder)
        session = RunSession(engines.with_engines(artifacts, folder), robot, options, say)
        verified.check_unchanged()
    except (ConfigError, InstructionError, ReleaseDelayError, KeyFileError) as error:
        say(str(error))
        return EXIT_BAD_INPUT
    except (ArtifactError, engines.EngineError) as error:
        say(str(error))
        return EXIT_REFUSED
    except OSError as error:
        say(str(error))
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        say("interrupted before anything was started")
        return EXIT_INTERRUPTED
    if not artifacts.trained:
        say("the weights of these artifacts are untrained: the robot will move, it will not navigate")
    sessions.append(session)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup asks to stay
            signal.signal(number, on_signal)
    try:
        result = session.run()
    except StoppedEarlyError as error:
        say(str(error))
        return EXIT_INTERRUPTED if signal.SIGINT in received else EXIT_DONE
    except CalibrationError as error:
        say(str(error))
        return EXIT_BAD_INPUT
    except (RefusedError, ArtifactError, BridgeUnavailable, LinkOpenError) as error:
        say(str(error))
        return EXIT_REFUSED
    for fault in result["faults"]:
        say(fault)
    try:
        write_result(args.json, result)
    except OutputError as error:
        say(f"the run ended, but its result could not be written: {error}")
        return EXIT_CHECK_FAILED
    if args.json != "-":
        say(json.dumps({key: result[key] for key in ("control", "reasoning", "delay_s", "bridge")}))
    if result["faults"]:
        return EXIT_CHECK_FAILED
    return EXIT_INTERRUPTED if signal.SIGINT in received else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
