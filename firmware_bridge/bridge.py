"""`edge-bridge`: the only process that commands the robot, and the one that stops it when the runner does not.

One thread: poll() on the sockets until an absolute deadline, then `BridgeCore.step`, then writes that never wait for
the robot. Import it without numpy, ML or vision: it must start fast and have little to fail.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import socket
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

from firmware_bridge.absent_robot import AbsentRobot
from firmware_bridge.backends import INSTALL, backend_opener, missing_link, robot_table
from firmware_bridge.client_link import USER_ONLY, ClientLink, SocketGroups, SocketTakenError
from firmware_bridge.core.config import (
    BRIDGE_PRIORITY,
    OBSERVER_SUFFIX,
    OPERATOR_SUFFIX,
    ConfigError,
    RobotConfig,
    load_robot_config,
)
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Backend, Inputs, Move, Outputs, Report, StopMotion
from firmware_bridge.system.latch_file import LatchFile, read_latch
from firmware_bridge.system.line_log import LineLog
from firmware_bridge.system.notify import Notifier
from firmware_bridge.system.output_file import check_output, write_descriptor, write_output
from firmware_bridge.system.process import lock_memory, settle_memory, signals_to_socket
from firmware_bridge.system.terminal import CommandParser, one_line, open_missing_streams, print_line

_OPERATORS: Final = 4  # at a time
_OBSERVERS: Final = 4
_LOG_TIMEOUT_S: Final = 0.5
_JOIN_AGAIN_NS: Final = 1_000_000_000
_LOOK_AGAIN_NS: Final = 1_000_000_000
_LAST_ZEROS: Final = 5  # ticks of zeros between a signal and the exit
_LATE_NS: Final = 50_000_000  # a step this late is no sign of life for the watchdog
_PAUSE_NS: Final = 1_000_000
"""Pause after each step, ns: a client that floods a socket must not keep a bridge of real-time priority from sleeping,
because LimitRTTIME ends it then. Far below every bound on a stop."""
_STARTING_S: Final = 20.0  # the unit's TimeoutStartSec, which moves on while the bridge waits for its interface
_EXTEND_NS: Final = 5_000_000_000

EPILOG: Final = """examples:
  edge-bridge --robot go2.toml --socket /run/tic-vla-edge/bridge.sock --json result.json
  edge-bridge stop --robot go2.toml      emergency stop: the bridges at these sockets stop and refuse to arm, also
                                         after a restart of the bridge; done when the robot itself reports that it
                                         stands still
  edge-bridge arm --robot go2.toml       permit the runner that waits now to arm once, within 10 s: after an emergency
                                         stop (operator, remote, GPIO file), from 2 s after it on, and before every
                                         arming where the robot file says operator_arm
  edge-bridge release --robot go2.toml   after a stop: send no command, so that a person can use the remote
  edge-bridge status --robot go2.toml    what the running bridge is doing
stop, arm, release and status look for a bridge at the installed service's socket (run them with sudo then, or as a
member of tic-vla-operators) and at the robot file's, or at --socket only. With a robot file that cannot be used, stop
looks at the usual places.
exit codes: 0 ended by a signal or the terminal's end, robot stopped (stop, arm, release, status: done); 1 internal
failure or removed sockets, robot stopped (stop: the robot has not reported that it stands still, or another bridge
has died or cannot be reached; use the remote); 2 bad arguments or robot file; 3 refused: another bridge owns the
socket (stop, arm, release, status: no bridge is running, or none that this user may reach; arm: no runner waits, a
stop came less than 2 s before, or more than one bridge); 130 interrupted (stop, arm, release, status)"""


class Bridge:
    """Shell around BridgeCore: joins sockets, robot and clock. Raises LinkOpenError, ConfigError, SocketTakenError."""

    def __init__(
        self,
        config: RobotConfig,
        log: LineLog,
        notifier: Notifier,
        latch_path: Path,
        groups: SocketGroups = USER_ONLY,
    ) -> None:
        """`latch_path`: file that keeps an emergency stop over restarts; `groups`: users that may use the sockets."""
        self._log = log
        self._notifier = notifier
        self._config = config
        # Only a process that serves needs the protocol's library; a missing one is found before the bridge is ready.
        self._open_backend = backend_opener(config)
        self._robot: Backend = AbsentRobot("")
        self._join_ns = 0  # when to try again
        with contextlib.ExitStack() as opened:  # what cannot be opened leaves none of the others behind
            self._link = ClientLink(config.bridge.socket, group=groups.runner)
            opened.callback(self._link.close)
            operators = Path(f"{config.bridge.socket}{OPERATOR_SUFFIX}")
            self._operators = ClientLink(operators, places=_OPERATORS, group=groups.operator)
            opened.callback(self._operators.close)
            observers = Path(f"{config.bridge.socket}{OBSERVER_SUFFIX}")
            self._observers = ClientLink(observers, places=_OBSERVERS, group=groups.runner)
            opened.callback(self._observers.close)
            self._join_robot()  # last: a second bridge must not disturb the robot's link
            opened.pop_all()
        self._estop_file = config.safety.estop_file
        latch = read_latch(latch_path)
        self._latch_file = LatchFile(latch_path, log.write)
        table = robot_table(config)
        self._core = BridgeCore(
            config.bridge, config.limits, config.safety, table, time.monotonic_ns(), latch=latch, robot=config.digest
        )
        self._period_ns = 1_000_000_000 // config.bridge.rate_hz
        self._wake_ns = self._pinged_ns = time.monotonic_ns()
        self.failed: str | None = None
        self._looked_ns = 0  # when the sockets' files were last looked for
        self._reported, self._ready, self._extended_ns = "", False, -_EXTEND_NS

    @property
    def greeting(self) -> str:
        """What this bridge serves, or what it waits for, in one line."""
        if isinstance(self._robot, AbsentRobot):
            return f"{self._robot.reason}; plug in the robot's cable, or correct the robot file"
        return f"ready, robot {self._config.name}, {self._config.address}, socket {self._config.bridge.socket}"

    def run(self, wakeup: socket.socket) -> None:
        """Serve until a byte arrives on `wakeup`; leave with the robot stopped, whatever happens."""
        try:
            outputs = self._step()
            while not self._wait(wakeup, outputs.wake_ns) and not self._is_cut_off():
                outputs = self._step()
            self._notifier.stopping("stopping the robot")
            self._step(shutdown=True)
            if self._core.status(0).commands:
                for _ in range(_LAST_ZEROS):
                    time.sleep(self._period_ns / 1e9)
                    self._step(shutdown=True)
        except BaseException:
            if self._core.status(0).commands:
                self._robot.write(Move(0.0, 0.0, 0.0))
                self._robot.write(StopMotion())
            raise
        finally:
            with contextlib.ExitStack() as closing:  # each is closed, whatever another one raises; the robot first
                closing.callback(self._latch_file.close, _LOG_TIMEOUT_S)
                for part in (self._observers, self._operators, self._link, self._robot):
                    closing.callback(part.close)

    def result(self) -> dict[str, object]:
        """The JSON result."""
        values = asdict(self._core.status(time.monotonic_ns()))
        malformed, reordered, failed_writes = self._robot.dropped()
        datagrams = {"client": self._link.malformed + self._operators.malformed, "robot": malformed}
        values |= {"malformed": datagrams, "reordered": reordered, "failed_writes": failed_writes}
        return {**values, "clipped": self._core.clipped}

    def _wait(self, wakeup: socket.socket, wake_ns: int) -> bool:
        """Wait for input or the deadline; True when it is time to leave."""
        self._wake_ns = wake_ns
        time.sleep(max(min(_PAUSE_NS, wake_ns - time.monotonic_ns()), 0) / 1e9)
        poller = select.poll()
        for file in (wakeup, *self._link.files(), *self._operators.files(), *self._observers.files()):
            poller.register(file, select.POLLIN)
        left_ns = wake_ns - time.monotonic_ns()
        ready = poller.poll(max(-(-left_ns // 1_000_000), 0))
        return any(fd == wakeup.fileno() for fd, _ in ready)

    def _is_cut_off(self) -> bool:
        """Whether an operator could not reach this bridge any more, as after its user's log-out: then it must end."""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns < _LOOK_AGAIN_NS:
            return False
        self._looked_ns = now_ns
        if self._operators.is_removed or self._link.is_removed:
            folder = self._config.bridge.socket.parent
            self.failed = f"the sockets in {folder} were removed, so no stop could reach this bridge; start it again"
            self._log.write(self.failed)
        return self.failed is not None

    def _join_robot(self) -> bool:
        """Open the robot's link as soon as it is there; whether that has happened in this call."""
        if not isinstance(self._robot, AbsentRobot):
            return False
        missing = missing_link(self._config)
        if missing is not None:
            self._robot = AbsentRobot(missing)
            return False
        # Its threads inherit a lower priority: a flood that keeps them busy must not hold this one on a single core.
        take_priority(BRIDGE_PRIORITY - 1)
        try:
            self._robot = self._open_backend(self._config, self._log.write)
        finally:
            take_priority(BRIDGE_PRIORITY)
        settle_memory()
        return True

    def _join_late(self) -> None:
        """Join a robot whose link has appeared. A device may appear before it can be opened: then try again later."""
        now_ns = time.monotonic_ns()
        if now_ns < self._join_ns:
            return
        try:
            if self._join_robot():
                self._log.write(self.greeting)
        except LinkOpenError as error:
            self._join_ns = now_ns + _JOIN_AGAIN_NS
            self._robot = AbsentRobot(str(error))

    def _step(self, *, shutdown: bool = False) -> Outputs:
        self._join_late()
        asleep_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
        messages, operator = self._link.receive(), self._operators.receive()
        robot = self._robot.read(time.monotonic_ns())
        estop = self._estop_file is not None and is_pressed(self._estop_file)
        inputs = Inputs(messages, self._link.connected, robot, operator, estop, asleep_ns, shutdown)
        outputs = self._core.step(inputs, time.monotonic_ns())
        for request in outputs.requests:
            self._robot.write(request)
        latch_is_kept = self._latch_file.keep(outputs.latch, outputs.status.stamp_ns)
        if outputs.latch and latch_is_kept and (self._latch_file.failed or self._latch_file.is_late):
            lost = "this stop ends with the bridge" if self._latch_file.failed else "a killed bridge loses this stop"
            reason = f"{outputs.status.reason}; NOT ON DISK: {lost}"
            outputs = replace(outputs, status=replace(outputs.status, reason=reason))
        if isinstance(self._robot, AbsentRobot):
            outputs = replace(outputs, status=replace(outputs.status, reason=self._robot.reason))
        self._pass_on(robot)
        self._link.send_status(outputs.status)
        if latch_is_kept:  # a stop that an operator has seen confirmed must survive a kill
            self._operators.send_status(outputs.status)
        self._report_progress(outputs.status)
        return outputs

    def _pass_on(self, robot: Report) -> None:
        """Send the robot's newest report to the observers, whose messages are dropped."""
        self._observers.malformed += len(self._observers.receive())
        for message in (robot.state, robot.battery):
            if message is not None:
                self._observers.send(message)

    def _report_start(self, text: str, now_ns: int) -> None:
        if not isinstance(self._robot, AbsentRobot):
            self._ready = self._notifier.ready(text)  # again until the manager has taken it
        elif now_ns - self._extended_ns >= _EXTEND_NS and self._notifier.extend(_STARTING_S):
            # Not ready: a runner that starts after this bridge would end at once without the interface.
            self._extended_ns = now_ns

    def _report_progress(self, status: BridgeStatus) -> None:
        line = f"{status.state}: {status.reason}"
        if not self._ready:
            self._report_start(line, status.stamp_ns)
        if line != self._reported:
            self._reported = line
            self._log.write(line)
            self._notifier.status(line)
        period_ns, late_ns = self._notifier.watchdog_period_ns, status.stamp_ns - self._wake_ns
        if period_ns is not None and status.stamp_ns - self._pinged_ns >= period_ns and late_ns < _LATE_NS:
            self._pinged_ns = status.stamp_ns
            self._notifier.watchdog()


def check_latch_path(path: Path) -> None:
    """Check that an emergency stop can be kept at a path. Raises ConfigError."""
    try:
        path.lstat()
    except FileNotFoundError:
        if not path.parent.is_dir():
            raise ConfigError(f"--latch {path}: expected a file in an existing folder; create {path.parent}") from None
    except OSError as error:
        raise ConfigError(f"--latch {path}: expected a file: {error.strerror}") from error
    if not path.name:
        raise ConfigError("--latch: expected the name of a file, found none")


def is_pressed(path: Path) -> bool:
    """Whether the emergency stop behind a GPIO value file is pressed: unless the file can be read and holds 0."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            return os.read(file, 8).strip() != b"0"
        finally:
            os.close(file)
    except OSError:
        return True


def take_priority(priority: int) -> None:
    """Give this thread, and those that it starts, a real-time priority where that is permitted.

    The installed service's is BRIDGE_PRIORITY, the runner's threads have less. A priority above it stays.
    """
    is_real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR)
    if is_real_time and os.sched_getparam(0).sched_priority > BRIDGE_PRIORITY:
        return
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def serve(config: RobotConfig, latch_path: Path, groups: SocketGroups) -> dict[str, object]:
    """Be the bridge until a signal; the JSON result. Raises what `Bridge` raises."""
    take_priority(BRIDGE_PRIORITY)  # first: threads inherit it
    with signals_to_socket() as wakeup:
        log = LineLog(sys.stderr, "edge-bridge")
        notifier = Notifier(os.environ)
        bridge = Bridge(config, log, notifier, latch_path, groups)
        log.write(bridge.greeting)
        settle_memory()
        if (unlocked := lock_memory()) is not None:
            log.write(unlocked)
        try:
            bridge.run(wakeup)
        finally:
            log.close(_LOG_TIMEOUT_S)
        return {**bridge.result(), **({} if bridge.failed is None else {"error": bridge.failed})}


def main(argv: list[str] | None = None) -> int:
    """Command line; see EPILOG for the exit codes."""
    open_missing_streams()
    parser = CommandParser(
        prog="edge-bridge",
        description="The only process that commands the robot: gates velocity commands and stops the robot within"
        " 300 ms of the last good one.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = ("serve", "stop", "arm", "release", "status")
    parser.add_argument("command", nargs="?", choices=commands, default="serve", help="default: serve")
    parser.add_argument("--robot", required=True, metavar="FILE.toml", help="robot file")
    parser.add_argument("--socket", type=Path, metavar="PATH", help="socket of the bridge, instead of the robot file's")
    parser.add_argument(
        "--latch", type=Path, metavar="PATH", help="file that keeps an emergency stop; default: SOCKET.latch"
    )
    parser.add_argument("--domain", type=int, metavar="N", help="DDS domain, instead of the robot file's")
    parser.add_argument("--runner-group", metavar="NAME", help="serve: group that may command (default: none)")
    parser.add_argument("--operator-group", metavar="NAME", help="serve: group that may stop and arm (default: none)")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    parser.add_argument("--version", action="store_true", help="print version, commit and artifact schema")
    if "--version" in (sys.argv[1:] if argv is None else argv):
        from firmware_bridge.core.version import version_line  # not part of the process that serves

        return _write_result(f"{version_line('edge-bridge')}\n")
    args = parser.parse_args(argv)
    try:
        if args.json not in (None, "-") and args.command != "stop":  # nothing may come before a stop
            check_output(Path(args.json))
    except OSError as error:
        _print(f"--json {args.json!r}: expected a file or -: {error.strerror or error}")
        return 2
    try:
        if args.command == "serve":
            config = load_robot_config(args.robot, socket=args.socket, domain=args.domain)
            if args.latch is not None:
                check_latch_path(args.latch)
            latch = Path(f"{config.bridge.socket}.latch") if args.latch is None else args.latch
            result = serve(config, latch, SocketGroups(args.runner_group, args.operator_group))
            code = int("error" in result)
        else:
            from firmware_bridge.operate import operate, sockets_of  # never part of the process that serves

            code, result = operate(args.command, *sockets_of(args.command, args.robot, args.socket))
    except (SocketTakenError, ConfigError, LinkOpenError) as error:
        _print(error)
        return 3 if isinstance(error, SocketTakenError) else 2
    except ModuleNotFoundError as error:
        _print(f"{error.name} is missing: {INSTALL[config.protocol]}")
        return 2
    except KeyboardInterrupt:  # of a process that serves it is a signal to leave
        _print(f"{args.command} interrupted, perhaps after it was sent; see: edge-bridge status")
        return 130
    return code if args.json is None else _write_result(json.dumps(result, indent=2) + "\n", args.json, code)


def _write_result(text: str, where: str = "-", code: int = 0) -> int:
    """Write to a file or to standard output; return `code`, or 1 when it cannot be written."""
    try:
        if where == "-":
            write_descriptor(sys.stdout.fileno(), text.encode())
        else:
            write_output(Path(where), text.encode())
    except OSError as error:
        _print(f"the result could not be written: {error.strerror or error}")
        return 1
    return code


def _print(message: object) -> None:
    print_line(f"edge-bridge: {one_line(message)}")


if __name__ == "__main__":
    sys.exit(main())
