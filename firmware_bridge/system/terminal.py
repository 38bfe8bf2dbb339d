"""Messages for a terminal: text from a file or a command line must not move its cursor, nor fill its screen."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from typing import Any, Final, NoReturn

LONGEST_LINE: Final = 1500
"""Longest message, characters; its middle is left out."""


def one_line(text: object) -> str:
    """Return a message as one printable line of at most LONGEST_LINE characters."""
    whole, half = str(text), LONGEST_LINE // 2 - 10
    line = _printable(whole[: LONGEST_LINE + 1])
    if len(line) > LONGEST_LINE:
        line = f"{line[:half]} [...] {_printable(whole[-half:])[-half:]}"
    return line


def _printable(text: str) -> str:
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def print_line(line: str) -> None:
    """Write a line to standard error at once. One that cannot be written is dropped: a stop must not wait for it."""
    with contextlib.suppress(OSError, ValueError):
        if sys.stderr is not None:
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()


def open_missing_streams() -> None:
    """Give a process that was started without standard streams some: no file or socket may get their numbers.

    What is written to such a standard output is an error, as on a full disk; standard error takes everything.
    """
    for number, flags in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, flags)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)


class CommandParser(argparse.ArgumentParser):
    """Argument parser whose errors are one printable line, after the usage."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse `--option=--`, which argparse of Python 3.11 takes for an empty list."""
        arguments = sys.argv[1:] if args is None else list(args)
        for each in arguments:
            if each == "--":
                break
            if each.startswith("--") and each.endswith("=--"):
                self.error(f"argument {each.removesuffix('=--')}: expected a value, found '--'")
        return super().parse_known_args(arguments, namespace)

    def error(self, message: str) -> NoReturn:
        """Print usage and message and end with exit code 2."""
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: error: {one_line(message)}\n")
