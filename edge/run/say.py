"""`edge-say`: gives a driving runner another instruction, or stops the robot when the text is a stop phrase."""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    command_line,
    messages,
)
from edge.run.stop_phrase import is_stop_phrase
from firmware_bridge.core.config import OPERATOR_SUFFIX, ROBOT_FILE_SOCKET, SERVICE_SOCKET, runtime_dirs
from firmware_bridge.system.terminal import CommandParser, one_line

ANSWER_S = 2.0
STOP_ANSWER_S = 3.0  # the runner waits up to 2 s for the robot to stand still
STOP: Final = "stop"
"""Text that the runner receives for every stop phrase."""

EXAMPLES = """examples:
  edge-run --artifacts out/nano --robot go2.toml --instructions say.sock --instruction "go down the corridor"
  edge-say "turn left and stop at the vending machine" --to say.sock
  edge-say stop --to say.sock

An instruction is followed from the next generation on; until then the robot drives by the previous one.

emergency stop: "stop", "halt", "freeze", "emergency stop", "stop now" and the like stop the robot and are never given
to the model. The bridge stops it as after `edge-bridge stop` and refuses to arm until `edge-bridge arm`; the run ends.
Case and punctuation do not matter. With any other word, as in "stop at the second door" or "stop, then turn left", the
text is an instruction: the model decides when to stop, or does not. It is no emergency stop. The fastest stops are the
keys of the robot's remote and `edge-bridge stop`, which need no runner.

exit codes: 0 the runner has accepted the instruction, or the bridge has confirmed the stop; 1 the runner has refused
            the instruction or is silent, or the stop is not confirmed: use the remote; 2 bad arguments, or no runner
            takes instructions there; 130 interrupted
"""


_print: Final = messages("edge-say")


class SayError(RuntimeError):
    """The instruction was not delivered; the message is one line with the reason."""


def say(path: Path, instruction: str, timeout_s: float = ANSWER_S) -> str:
    """Send an instruction and return the accepted text. Raises InstructionError, SayError, OSError."""
    from edge.reasoning.prompt import check_instruction  # loads NumPy and the tokenizer: a stop must not wait for them

    with _question(path, check_instruction(instruction)) as asking:
        answer = _answer(asking, path, timeout_s)
    if not isinstance(answer, dict) or "accepted" not in answer:
        why = answer.get("error", answer) if isinstance(answer, dict) else answer
        raise SayError(f"the runner has refused it: {why}")
    return str(answer["accepted"])


def stop_robot(path: Path, bridge: Path | None = None) -> int:
    """Stop the robot by the operator's socket of every bridge found and by the runner; returns the exit code.

    `path`: the runner's instruction socket; `bridge`: socket of the only bridge to stop; None: those that
    `edge-bridge stop` finds and the runner's own.
    """
    from firmware_bridge.operate import operate

    defaults = (SERVICE_SOCKET, *(folder / ROBOT_FILE_SOCKET for folder in runtime_dirs()))
    bridges = [bridge] if bridge else [each for each in defaults if not _is_absent(each)]
    with contextlib.ExitStack() as stack:
        try:
            asking: socket.socket | None = stack.enter_context(_question(path, STOP))
        except OSError as error:
            asking = None
            _print(f"{path}: no runner takes instructions there ({error.strerror or error})")
        code = operate(STOP, *bridges)[0] if bridges else EXIT_REFUSED
        answer = None if asking is None else _stop_answer(asking, path)
    runners = None if answer is None else Path(str(answer.get("bridge")))
    confirmed = answer is not None and answer.get("confirmed") is True
    if runners is not None and (code != EXIT_DONE or runners not in bridges or not confirmed):
        # The runner names its bridge: that bridge's state decides, and that of any bridge which the user named. It may
        # have died in a list of several.
        runners_code = operate(STOP, runners)[0]
        code = runners_code if bridge is None else max(code, runners_code)
    if code == EXIT_DONE and (bridge is not None or runners is not None):
        sys.stdout.write("stopped: the bridge confirms it; before the robot moves again: `edge-bridge arm`, new run\n")
        return EXIT_DONE
    if code == EXIT_REFUSED and bridge is None and confirmed:
        sys.stdout.write(
            "stopped: the runner has ended its run and its bridge confirms it; no operator's stop was possible, so a "
            "new run can arm: to prevent that, sudo edge-bridge stop\n"
        )
        return EXIT_DONE
    found = "a bridge has stopped, which need not be this runner's" if code == EXIT_DONE else "no bridge confirms it"
    _print(f"the stop is NOT confirmed: {found}; use the remote, or switch the robot off")
    return EXIT_CHECK_FAILED


@contextlib.contextmanager
def _question(path: Path, instruction: str) -> Iterator[socket.socket]:
    """Send to the runner; return the socket that receives its answer. Raises OSError."""
    with contextlib.ExitStack() as stack:
        asking = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        try:
            asking.bind(str(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tic-"))) / "a"))
        except OSError:
            if instruction != STOP:
                raise
            # On a full disk the runner cannot answer, but it stops.
        asking.settimeout(ANSWER_S if instruction != STOP else 0.0)  # a full queue must not delay the operator's stop
        asking.sendto(json.dumps({"instruction": instruction}).encode(), str(path))
        yield asking


def _answer(asking: socket.socket, path: Path, timeout_s: float) -> Any:
    """Return the runner's answer. Raises SayError, OSError."""
    asking.settimeout(timeout_s)
    try:
        return json.loads(asking.recv(65_536))
    except TimeoutError:
        raise SayError(f"{path}: no answer within {timeout_s:g} s; expected a runner that drives there") from None
    except (ValueError, RecursionError) as error:
        raise SayError(f"{path}: expected a runner's answer, found something else ({error})") from error


def _stop_answer(asking: socket.socket, path: Path) -> dict[str, Any] | None:
    """Return the runner's answer to a stop phrase; None without a valid one."""
    try:
        answer = _answer(asking, path, STOP_ANSWER_S)
    except (SayError, OSError) as error:
        _print(str(error))
        return None
    if isinstance(answer, dict) and "stopped" in answer and str(answer.get("bridge", "\0")).isprintable():
        return answer
    _print(f"{path}: expected the runner to stop, found the answer {answer}")
    return None


def _is_absent(bridge: Path) -> bool:
    """Return whether no bridge exists; a bridge that this user cannot see counts as present."""
    try:
        Path(f"{bridge}{OPERATOR_SUFFIX}").lstat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


def parser() -> argparse.ArgumentParser:
    """Command line."""
    p = CommandParser(
        "edge-say", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("text", metavar="TEXT", help="what the robot is to do, in plain words; a stop phrase stops it")
    p.add_argument("--to", type=Path, required=True, metavar="PATH", help="the runner's --instructions")
    p.add_argument(
        "--socket",
        type=Path,
        metavar="PATH",
        help="socket of edge-bridge for a stop phrase (default: the installed service's, this user's, the runner's)",
    )
    return p


@command_line("edge-say")
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    try:
        if is_stop_phrase(args.text):
            return stop_robot(args.to, args.socket)
        return _hand_over(args.to, args.text)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _hand_over(path: Path, text: str) -> int:
    from edge.reasoning.prompt import InstructionError

    try:
        accepted = say(path, text)
    except SayError as error:
        _print(str(error))
        return EXIT_CHECK_FAILED
    except InstructionError as error:
        _print(str(error))
        return EXIT_BAD_INPUT
    except OSError as error:
        _print(f"{path}: expected the socket of a runner ({error.strerror or error})")
        return EXIT_BAD_INPUT
    sys.stdout.write(f"{one_line(accepted)}\n")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
