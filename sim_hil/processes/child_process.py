"""Child processes that report to their parent in lines of JSON: start, send, read without waiting, end.

The upper half is the parent's side, the lower half the child's. Workers of the benchmark and the training
(`sim_hil.benchmark.workers.worker_pool`), camera processes and the peers of the runtime benchmark use it.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final, TextIO

Message = dict[str, Any]

_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


class ChildProcess:
    """A process and the pipe that it writes lines to; ended by `close`.

    By default the child writes its lines to standard output. With `own_pipe` it is given the arguments `--fd N --parent
    PID` and writes to descriptor N, because the libraries that it loads print to standard output.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        log: Path | None = None,
        own_pipe: bool = False,
        pass_fds: Sequence[int] = (),
        env: Mapping[str, str] | None = None,
        new_session: bool = False,
    ) -> None:
        """`log` takes what the child prints (None: the parent's standard error); `env` is added to the environment.

        `new_session`: Ctrl-C reaches the parent alone. Raises OSError when the process cannot be started.
        """
        reading, writing = os.pipe()
        try:
            stream: IO[bytes] | None = None if log is None else log.open("wb")
            try:
                extra = ["--fd", str(writing), "--parent", str(os.getpid())] if own_pipe else []
                self._process = subprocess.Popen(
                    [*command, *extra],
                    stdin=subprocess.PIPE,
                    stdout=stream if own_pipe else writing,
                    stderr=stream,
                    pass_fds=(*pass_fds, writing) if own_pipe else tuple(pass_fds),
                    env=None if env is None else {**os.environ, **env},
                    start_new_session=new_session,
                )
            finally:
                if stream is not None:
                    stream.close()
        except BaseException:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        os.set_blocking(reading, False)
        self._reading: int | None = reading
        self._partial = b""
        self.at_end = False
        """Whether the child has closed its end of the pipe."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def fileno(self) -> int:
        """Descriptor that becomes readable when there is something to read; raises ValueError after `close`."""
        if self._reading is None:
            raise ValueError("the pipe of a child process is closed")
        return self._reading

    def send(self, line: bytes) -> bool:
        """Write a line to the child's standard input; False when the child is gone."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()
        except (OSError, ValueError):
            return False
        return True

    def close_input(self) -> None:
        """End the child's standard input; may be called twice."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    def read(self) -> list[bytes]:
        """Whole lines that have arrived since the last call. Never waits."""
        data = b""
        with suppress(BlockingIOError):
            while not self.at_end:
                chunk = os.read(self.fileno(), 1 << 16)
                data += chunk
                self.at_end = not chunk
        *lines, self._partial = (self._partial + data).split(b"\n")
        return lines

    def read_one(self, timeout_s: float) -> bytes | None:
        """The next line of a child that answers line by line, None at the end of its pipe. Raises TimeoutError."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while not (lines := self.read()):
            if self.at_end:
                return None
            left_s = (deadline_ns - time.monotonic_ns()) / 1e9
            if left_s <= 0:
                raise TimeoutError(f"no answer within {timeout_s:g} s")
            select.select([self.fileno()], [], [], left_s)
        return lines[0]

    def poll(self) -> int | None:
        """Exit code, negative for a signal; None while the child runs."""
        return self._process.poll()

    def wait(self, timeout_s: float) -> int | None:
        """Exit code, waited for; None if the child still runs after that time."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._process.terminate()

    def kill(self) -> None:
        """Send SIGKILL."""
        self._process.kill()

    def close(self, grace_s: float) -> None:
        """End the child's input, wait `grace_s` for its exit, then kill it; may be called twice."""
        self.close_input()
        if self.wait(grace_s) is None:
            self._process.kill()
            self._process.wait()
        if self._reading is not None:
            os.close(self._reading)
            self._reading = None


def parse_message(line: bytes) -> Message | None:
    """A line as a JSON object; None for any other line, such as one that a dying process has cut short."""
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def exit_text(code: int) -> str:
    """How a process ended, for a message."""
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def last_lines(path: Path, lines: int = 8, limit_bytes: int = 16_384) -> list[str]:
    """The last non-empty lines of a text file, as far as they can be read."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - limit_bytes))
            text = stream.read().decode("utf-8", "replace")
    except OSError:
        return []
    return [line.rstrip() for line in text.splitlines() if line.strip()][-lines:]


def signal_on_parent_death(number: signal.Signals) -> None:
    """In the child: let the kernel send this process a signal when its parent ends. Safe between fork and exec."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, number)


def end_with_parent(parent_pid: int) -> None:
    """In the child: end when the parent ends, however it ends."""
    signal_on_parent_death(signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)  # the parent had ended before


def take_standard_output() -> TextIO:
    """In the child: the pipe to the parent; what a library prints to standard output goes to standard error."""
    pipe = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return pipe


def write_message(pipe: TextIO, message: Mapping[str, Any]) -> None:
    """In the child: send a message to the parent; raises BrokenPipeError when the parent is gone."""
    pipe.write(json.dumps(message) + "\n")
    pipe.flush()


def input_is_open() -> bool:
    """In the child: whether the parent still holds this process's standard input open and has sent nothing."""
    return not select.select([sys.stdin], [], [], 0)[0]
