"""`edge-bridge`: the only process that commands the robot, and the one that stops it when the runner does not.

One thread: poll() on the socket until an absolute deadline, then `BridgeCore.step`, then writes that never wait for the
robot. Import it without numpy, ML or vision: it must start fast and have little to fail.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import select
import signal
import socket
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from firmware_bridge.config import ConfigError, RobotConfig, load_robot_config
from firmware_bridge.core import BridgeCore, Call, Feedback, Inputs, Move, Outputs
from firmware_bridge.line_log import LineLog
from firmware_bridge.link import MAX_DATAGRAM_BYTES, BridgeStatus, LinkError, Message, decode, encode
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import Bus, DdsError, take_each
from firmware_bridge.unitree.idl import SportModeState_
from firmware_bridge.unitree.rpc import RpcClient, move_parameter

_STATUS_PERIOD_NS: Final = 100_000_000
_MAX_DATAGRAMS_A_STEP: Final = 64
_MAX_UNANSWERED: Final = 32
_LOG_TIMEOUT_S: Final = 0.5
_LAST_ZEROS: Final = 5  # ticks of zeros between a signal and the exit

EPILOG: Final = """examples:
  edge-bridge --robot firmware_bridge/robots/go2_sim.toml
  edge-bridge --robot go2.toml --socket /run/tic-vla-edge/bridge.sock --json result.json
exit codes: 0 ended by SIGINT or SIGTERM, robot stopped; 1 internal failure, robot stopped; 2 bad arguments or robot
file; 3 refused: another bridge owns the socket"""


class SocketTakenError(RuntimeError):
    """Another bridge listens at the socket's path."""


def listen(path: Path) -> socket.socket:
    """Listening socket of mode 0600; replaces a socket file nobody listens at.

    Raises SocketTakenError, or ConfigError when something else is in the way or the directory is not usable.
    """
    if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
        # Connecting to a plain file is "refused" too, and it must not be taken for a socket left behind.
        raise ConfigError(f"socket {path}: expected a free path, found a file; give another --socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise ConfigError(f"socket {path}: cannot be used: {error.strerror}; give another --socket") from error
        else:
            raise SocketTakenError(f"another bridge listens at {path}; stop it first, one process commands a robot")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        umask = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(umask)
    except OSError as error:
        listener.close()
        raise ConfigError(f"socket {path}: cannot be made: {error.strerror}; give another --socket") from error
    listener.listen(4)
    listener.setblocking(False)
    return listener


class ClientLink:
    """The bridge's end of the socket: one client, later ones are turned away, nothing here waits."""

    def __init__(self, path: Path) -> None:
        self.malformed = 0
        self._path = path
        self._listener = listen(path)
        self._client: socket.socket | None = None
        self._told_ns = 0
        self._told_state = ""

    @property
    def connected(self) -> bool:
        """Whether a runner is connected."""
        return self._client is not None

    def files(self) -> list[socket.socket]:
        """What to poll."""
        return [self._listener] if self._client is None else [self._listener, self._client]

    def receive(self) -> list[Message]:
        """Datagrams that have arrived; notices connections and disconnections. Malformed ones are counted, ignored."""
        messages: list[Message] = []
        if self._client is not None:
            for data in self._datagrams(self._client):
                try:
                    messages.append(decode(data))
                except LinkError:
                    self.malformed += 1
        with contextlib.suppress(BlockingIOError):
            fresh, _ = self._listener.accept()
            if self._client is None:
                fresh.setblocking(False)
                self._client, self._told_state = fresh, ""
            else:
                fresh.close()  # without a greeting: its BridgeClient knows what that means
        return messages

    def tell(self, status: BridgeStatus) -> None:
        """Send the status when its state has changed, and at 10 Hz; dropped when the client does not read."""
        due = status.state != self._told_state or status.stamp_ns - self._told_ns >= _STATUS_PERIOD_NS
        if self._client is not None and due:
            self._told_ns, self._told_state = status.stamp_ns, status.state
            with contextlib.suppress(OSError):  # a closed connection is noticed by receive()
                self._client.send(encode(status))

    def close(self) -> None:
        """Disconnect the client and remove the socket file."""
        self._drop_client()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _datagrams(self, client: socket.socket) -> Iterator[bytes]:
        for _ in range(_MAX_DATAGRAMS_A_STEP):
            try:
                data = client.recv(MAX_DATAGRAM_BYTES + 1)  # one more: a longer datagram fails the length check
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._drop_client()
                return
            yield data

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


class Bridge:
    """Shell around BridgeCore: joins socket, robot and clock. Raises DdsError, ConfigError, SocketTakenError."""

    def __init__(self, config: RobotConfig, log: LineLog) -> None:
        self._log = log
        self._bus = Bus(config.dds)
        self._sport = RpcClient(self._bus, ids.SPORT_SERVICE, allowed=ids.BRIDGE_ALLOWED)
        self._states = self._bus.reader(ids.SPORT_STATE_TOPIC, SportModeState_)
        self._link = ClientLink(config.bridge.socket)
        self._core = BridgeCore(config.bridge, config.limits, time.monotonic_ns())
        self._period_ns = 1_000_000_000 // config.bridge.rate_hz
        self._said = ""
        self._sent: dict[int, str] = {}
        self.malformed_states = 0

    def run(self, wakeup: socket.socket) -> None:
        """Serve until a byte arrives on `wakeup`; leave with the robot stopped, whatever happens."""
        try:
            outputs = self._step()
            while not self._wait(wakeup, outputs.wake_ns):
                outputs = self._step()
            self._step(shutdown=True)
            if self._core.status(0).commands:
                for _ in range(_LAST_ZEROS):
                    time.sleep(self._period_ns / 1e9)
                    self._step(shutdown=True)
        except BaseException:
            self._last_words()
            raise
        finally:
            self._link.close()

    def result(self) -> dict[str, object]:
        """The JSON result."""
        status = self._core.status(time.monotonic_ns())
        return {
            "state": status.state,
            "reason": status.reason,
            "commands": status.commands,
            "rejected": status.rejected,
            "last_seq": status.last_seq,
            "last_command": list(status.last_command),
            "zero_after_stop": status.zero_after_stop,
            "malformed": {"client": self._link.malformed, "robot": self.malformed_states + self._sport.malformed},
            "failed_writes": self._sport.failed_writes,
        }

    def _wait(self, wakeup: socket.socket, wake_ns: int) -> bool:
        """Wait for input or the deadline; True when it is time to leave."""
        poller = select.poll()
        for file in (wakeup, *self._link.files()):
            poller.register(file, select.POLLIN)
        left_ns = wake_ns - time.monotonic_ns()
        ready = poller.poll(max(-(-left_ns // 1_000_000), 0))
        return any(fd == wakeup.fileno() for fd, _ in ready)

    def _step(self, *, shutdown: bool = False) -> Outputs:
        messages = self._link.receive()
        feedback = self._newest_feedback()
        inputs = Inputs(messages, self._link.connected, feedback, shutdown)
        outputs = self._core.step(inputs, time.monotonic_ns())
        for request in outputs.requests:
            self._write(request)
        self._link.tell(outputs.status)
        self._report_progress(outputs.status)
        return outputs

    def _newest_feedback(self) -> Feedback | None:
        newest = None
        for sample in take_each(self._states):
            if sample is None:
                self.malformed_states += 1
            else:
                newest = Feedback(time.monotonic_ns(), sample.mode)
        return newest

    def _write(self, request: Move | Call) -> None:
        if isinstance(request, Move):
            parameter = move_parameter(request.vx_mps, request.vy_mps, request.wz_radps)
            self._sport.send(ids.MOVE, parameter, noreply=True)
            return
        request_id = self._sport.send(request.api_id)
        if request_id is not None:
            if len(self._sent) >= _MAX_UNANSWERED:
                self._sent.clear()
            self._sent[request_id] = ids.SPORT_API_NAMES[request.api_id]

    def _report_progress(self, status: BridgeStatus) -> None:
        said = f"{status.state}: {status.reason}"
        if said != self._said:
            self._said = said
            self._log.say(said)
        for answer in self._sport.responses():
            name = self._sent.pop(answer.request_id, None)
            if name is not None and answer.code != ids.OK:
                self._log.say(f"the robot answered {name} with error {answer.code}")

    def _last_words(self) -> None:
        if self._core.status(0).commands:
            self._write(Move(0.0, 0.0, 0.0))
            self._write(Call(ids.STOP_MOVE))


@contextlib.contextmanager
def signals_to_socket() -> Iterator[socket.socket]:
    """A socket that becomes readable at SIGINT or SIGTERM, so that poll() wakes up."""
    readable, writable = socket.socketpair()
    with readable, writable:
        writable.setblocking(False)
        signal.set_wakeup_fd(writable.fileno())
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        try:
            yield readable
        finally:
            signal.set_wakeup_fd(-1)


def main(argv: list[str] | None = None) -> int:
    """Command line; see EPILOG for the exit codes."""
    parser = argparse.ArgumentParser(
        prog="edge-bridge",
        description="The only process that commands the robot: gates velocity commands and stops the robot within"
        " 300 ms of the last good one.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--robot", required=True, metavar="FILE.toml", help="robot file")
    parser.add_argument("--socket", type=Path, metavar="PATH", help="socket to listen at, instead of the robot file's")
    parser.add_argument("--domain", type=int, metavar="N", help="DDS domain, instead of the robot file's")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    args = parser.parse_args(argv)
    try:
        config = load_robot_config(args.robot, socket=args.socket, domain=args.domain)
        with signals_to_socket() as wakeup:
            log = LineLog(sys.stderr, "edge-bridge")
            bridge = Bridge(config, log)
            dds, path = config.dds, config.bridge.socket
            log.say(f"ready, robot {config.name}, domain {dds.domain} on {dds.interface}, socket {path}")
            gc.freeze()  # what exists now stays; collections look at a step's objects only
            try:
                bridge.run(wakeup)
            finally:
                log.close(_LOG_TIMEOUT_S)
    except SocketTakenError as error:
        sys.stderr.write(f"edge-bridge: {error}\n")
        return 3
    except (ConfigError, DdsError) as error:
        sys.stderr.write(f"edge-bridge: {error}\n")
        return 2
    text = json.dumps(bridge.result(), indent=2) + "\n"
    try:
        if args.json == "-":
            sys.stdout.write(text)
        elif args.json:
            partial = Path(args.json + ".partial")
            partial.write_text(text, encoding="utf-8")
            partial.replace(args.json)
    except OSError as error:
        sys.stderr.write(f"edge-bridge: the result could not be written: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
