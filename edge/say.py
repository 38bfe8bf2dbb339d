"""`edge-say`: gives a runner that drives another instruction (`edge-run --instructions PATH`)."""

from __future__ import annotations

import argparse
import json
import socket
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from edge.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, command_line
from edge.prompt import InstructionError, check_instruction

ANSWER_S = 2.0

EXAMPLES = """examples:
  edge-run --artifacts out/nano --robot go2.toml --instructions say.sock --instruction "go down the corridor"
  edge-say "turn left and stop at the vending machine" --to say.sock

The runner follows it from its next thought on; what it has been driving by goes on until then.
exit codes: 0 the runner has accepted it, 1 it has refused it or is silent, 2 bad arguments, or nobody takes
            instructions there, 130 interrupted
"""


class SayError(RuntimeError):
    """The instruction has not arrived; one line: why."""


def say(path: Path, instruction: str, timeout_s: float = ANSWER_S) -> str:
    """Hand an instruction over and return what was accepted. Raises InstructionError, SayError, OSError."""
    line = json.dumps({"instruction": check_instruction(instruction)}).encode()
    with tempfile.TemporaryDirectory(prefix="tic-") as own, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
        asking.bind(str(Path(own) / "a"))
        asking.settimeout(timeout_s)
        asking.sendto(line, str(path))
        try:
            answer = json.loads(asking.recv(65_536))
        except TimeoutError:
            raise SayError(f"{path}: no answer within {timeout_s:g} s; expected a runner that drives there") from None
        except ValueError as error:
            raise SayError(f"{path}: expected a runner's answer, found something else ({error})") from error
    if not isinstance(answer, dict) or "accepted" not in answer:
        why = answer.get("error", answer) if isinstance(answer, dict) else answer
        raise SayError(f"the runner has refused it: {why}")
    return str(answer["accepted"])


def parser() -> argparse.ArgumentParser:
    """Command line."""
    p = argparse.ArgumentParser(
        "edge-say", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("text", metavar="TEXT", help="what the robot is to do, in plain words")
    p.add_argument("--to", type=Path, required=True, metavar="PATH", help="the runner's --instructions")
    return p


@command_line("edge-say")
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    try:
        accepted = say(args.to, args.text)
    except SayError as error:
        sys.stderr.write(f"edge-say: {error}\n")
        return EXIT_CHECK_FAILED
    except InstructionError as error:
        sys.stderr.write(f"edge-say: {error}\n")
        return EXIT_BAD_INPUT
    except OSError as error:
        sys.stderr.write(f"edge-say: {args.to}: expected the socket of a runner ({error.strerror or error})\n")
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    sys.stdout.write(f"{accepted}\n")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
