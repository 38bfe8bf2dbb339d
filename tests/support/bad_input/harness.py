"""Runs a command with one bad value at a time and judges each answer."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from edge.signature import keygen
from tests.support.bad_input.values import Bad, full_outputs

LIMIT_S: Final = 30.0
CACHE: Final = ".cache/"
LONGEST_LINE: Final = 2000
Values = Callable[[Path], Iterator[Bad]]


@dataclass(frozen=True)
class Command:
    """A command line that is right, and for each of its arguments the values that are wrong.

    `good`: all arguments, in which `{folder}` is the folder of the harness; `bad`: option, or index of a positional
    argument in `good`, -> its bad values; `quick`: a complete short run, to which `--json` is added with full disks.
    """

    name: str
    module: str
    good: str
    bad: Mapping[str | int, Values]
    quick: str = ""
    function: str = "main"
    codes: tuple[int, ...] = (1, 2, 3)
    quick_notes: int = 0
    """Lines that the short run prints before its error."""
    says: tuple[str, ...] = ()
    """What messages call a positional argument, where not by its value."""
    notes: int = 0
    """Lines that a command may print before its error."""


@dataclass(frozen=True)
class Case:
    """A command line with one bad value."""

    what: str
    argv: tuple[str, ...]
    names: tuple[str, ...]
    """Texts of which the message must contain one."""
    bad: Bad
    stdout: str = ""
    notes: int = 0


@dataclass(frozen=True)
class Answer:
    """The answer to a case: its faults are empty where the command has refused it clearly."""

    case: Case
    code: int | None
    err: str
    seconds: float
    faults: tuple[str, ...]


def prepare(folder: Path) -> None:
    """Make what good command lines name, in a folder that other users may read."""
    folder.chmod(0o755)
    (folder / "bad").mkdir()
    keygen(folder / "release.pem")


def cases(command: Command, folder: Path) -> Iterator[Case]:
    """Every case of a command."""
    good = shlex.split(command.good.format(folder=folder))
    for place, values in command.bad.items():
        for bad in values(folder / "bad"):
            yield Case(
                f"{place} {bad.label}", tuple(_with(good, place, bad.text)), (*_names(place, bad), *command.says), bad
            )
    yield Case("unknown option", (*good, "--no-such-option"), ("--no-such-option",), Bad("", ""))
    yield Case("superfluous argument", (*good, "superfluous\x1b[2J\n"), ("superfluous",), Bad("", ""))
    if command.quick:
        quick = shlex.split(command.quick.format(folder=folder))
        for bad in full_outputs(folder / "bad"):
            yield Case(
                f"--json {bad.label}",
                (*quick, "--json", bad.text),
                _names("--json", bad),
                bad,
                notes=command.quick_notes,
            )
        full = Case(
            "--json - to a full disk",
            (*quick, "--json", "-"),
            ("standard output",),
            Bad("", ""),
            "/dev/full",
            command.quick_notes,
        )
        yield full


class Servers:
    """Processes that run cases, one for each module, which is imported once; a context manager that ends them."""

    def __init__(self) -> None:
        self._started: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> Servers:
        return self

    def __exit__(self, *error: object) -> None:
        for server in self._started.values():
            with server:  # waits for its end
                pass

    def answers(self, module: str, function: str, sent: Sequence[Mapping[str, object]]) -> list[dict[str, Any]]:
        """Run the cases in forks of the module's process; returns one answer for each."""
        if module not in self._started:
            self._started[module] = subprocess.Popen(
                [sys.executable, "-m", "tests.support.bad_input.server"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"},
            )  # fmt: skip
        server = self._started[module]
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps({"module": module, "function": function, "cases": sent}) + "\n")
        server.stdin.flush()
        try:
            return [json.loads(server.stdout.readline()) for _ in sent]
        except BaseException:  # also a test's time limit: its answers are not those of the next command
            server.kill()
            del self._started[module]
            raise


def run(command: Command, folder: Path, chosen: Sequence[Case], servers: Servers) -> list[Answer]:
    """Run cases of a command and judge the answers."""
    sent = []
    for number, case in enumerate(chosen):
        own = folder / "runs" / f"{command.name.replace(' ', '-')}-{number}"
        own.mkdir(parents=True)
        own.chmod(0o777)
        sent.append(
            {
                "program": command.name, "argv": case.argv, "cwd": str(own), "limit_s": LIMIT_S, "stdout": case.stdout,
                "unprivileged": case.bad.unprivileged, "small_files": case.bad.small_files,
            }
        )  # fmt: skip
    before = _listing(folder / "bad" / "outputs")
    answers = []
    for case, about, found in zip(chosen, sent, servers.answers(command.module, command.function, sent), strict=True):
        left = {name for name in _listing(Path(str(about["cwd"]))) if not name.startswith(CACHE)}
        faults = _judge(command, case, found["code"], found["err"], left)
        answers.append(Answer(case, found["code"], found["err"], found["s"], faults))
    if new := _listing(folder / "bad" / "outputs") - before:
        raise AssertionError(f"{command.name}: left {sorted(new)} where nothing could be written whole")
    return answers


def _judge(command: Command, case: Case, code: int | None, err: str, left: set[str]) -> tuple[str, ...]:
    faults = []
    if code is None:
        return (f"did not end within {LIMIT_S:g} s",)
    if code not in command.codes:
        faults.append(f"exit code {code}, expected one of {command.codes}")
    if "Traceback" in err or "Exception ignored" in err:
        faults.append("a traceback")
    usage, _, _ = err.partition(": error: ")
    lines = (err.removeprefix(usage) if usage.startswith("usage:") and usage != err else err).splitlines()
    if not 1 <= len(lines) <= 1 + command.notes + case.notes:
        faults.append(f"{len(lines)} lines, expected one")
    text = " ".join(lines)
    if any(len(line) > LONGEST_LINE for line in lines):
        faults.append(f"a line of {max(map(len, lines))} characters")
    if any(ord(each) < 32 or 127 <= ord(each) < 160 for line in lines for each in line):
        faults.append("control characters in the message")
    if any(case.names) and not any(name and name in text for name in case.names):
        faults.append(f"the message names none of {case.names}")
    if left:
        faults.append(f"left {sorted(left)[:4]}")
    return tuple(faults)


def _with(good: Sequence[str], place: str | int, text: str) -> list[str]:
    """The command line with one value replaced, or its option added."""
    if isinstance(place, int):
        return [*good[:place], text, *good[place + 1 :]]
    if place in good:
        at = good.index(place)
        return [*good[:at], f"{place}={text}", *good[at + 2 :]]
    return [*good, f"{place}={text}"]


def _names(place: str | int, bad: Bad) -> tuple[str, ...]:
    """The message names the option, or the bad value; of a path its last part will do."""
    name = Path(bad.text).name if "/" in bad.text else bad.text
    pieces = "".join(each if each.isprintable() else "\n" for each in name).split("\n")
    plain = max(pieces, key=len)[:100]
    options = [place, place.removeprefix("--").replace("-", " ")] if isinstance(place, str) else []
    setting = [bad.text.partition("=")[0].rpartition(".")[2]] if place == "--set" else []
    return (*options, plain, *setting)


def _listing(folder: Path) -> set[str]:
    if not folder.exists():
        return set()
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}
