"""Exit codes and result files that every command line shares."""

from __future__ import annotations

import contextlib
import errno
import functools
import importlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Final, ParamSpec, TextIO

from firmware_bridge.core.version import version_line
from firmware_bridge.system.output_file import (
    check_output,
    open_through,
    partial_of,
    regular_target,
    replace_regular,
    write_output,
)
from firmware_bridge.system.terminal import one_line, open_missing_streams, print_line

P = ParamSpec("P")

EXIT_DONE = 0
EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_REFUSED = 3
EXIT_INTERRUPTED = 130
LONGEST_S = 2_592_000.0
"""Longest `--duration` of a run, s: 30 days."""


class OutputError(RuntimeError):
    """An output that the user has named could not be written: one line, the exit code is EXIT_CHECK_FAILED."""


def check_result_target(where: str | None, option: str = "--json") -> None:
    """Refuse, before a long run, a place that its result cannot be written to; raises OSError with one clear line."""
    if where is None or where == "-":
        return
    try:
        check_output(Path(where))
    except OSError as error:
        raise OSError(
            f"{option} {where or repr(where)}: expected a file to write or -: {error.strerror or error}"
        ) from error


def check_result_directory(folder: Path | None, option: str = "--out") -> None:
    """Refuse, before a long run, a folder that cannot be created or written to; raises OSError with one clear line."""
    if folder is None:
        return
    try:
        try:
            folder.stat()
        except FileNotFoundError:
            check_output(folder / "result")
            return
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            raise NotADirectoryError(errno.ENOTDIR, "not a directory that can be written to")
    except OSError as error:
        raise OSError(f"{option} {folder}: expected a directory: {error.strerror or error}") from error


def write_result(where: str | None, result: Mapping[str, Any]) -> None:
    """Write a result as JSON to a file (see `write_named`) or to standard output for `-`; raises OutputError."""
    if where is None:
        return
    text = json.dumps(result, indent=1) + "\n"
    if where != "-":
        with _named(where):
            Path(where).parent.mkdir(parents=True, exist_ok=True)
        write_named(Path(where), text)
        return
    with _named("standard output"):
        sys.stdout.write(text)
        sys.stdout.flush()


def write_named(path: Path, text: str | bytes) -> None:
    """Write a file that the user has named, as `write_whole` does; raises OutputError (see `command_line`)."""
    with _named(path):
        write_whole(path, text)


@contextlib.contextmanager
def named_file(path: Path) -> Iterator[Path]:
    """A path for a library to write to; its file then becomes what the user has named. Raises OutputError.

    OSErrors of the library are OutputErrors too.
    """
    with _named(path):
        target = regular_target(path)
        if target is not None:
            partial = partial_of(target)
            try:
                yield partial
                with partial.open("rb") as file:
                    os.fsync(file.fileno())
                replace_regular(partial, target)
            finally:
                partial.unlink(missing_ok=True)
            return
        with tempfile.TemporaryDirectory(prefix="tic-") as folder:
            yield Path(folder) / path.name
            write_output(path, (Path(folder) / path.name).read_bytes())


def write_whole(path: Path, text: str | bytes) -> None:
    """Write a file in one rename, so that no reader sees a part of it. Raises OSError and leaves no file then.

    A device or a FIFO is written in place. Of a symbolic link, the target file is replaced.
    """
    write_output(path, text.encode() if isinstance(text, str) else text)


def open_stream(path: Path) -> TextIO:
    """Open a file that is written line by line, a device or a FIFO too; raises OSError, also without a reader."""
    if regular_target(path) is not None:
        return path.open("w", encoding="utf-8")
    descriptor = open_through(path)
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "w", encoding="utf-8")


@contextlib.contextmanager
def _named(what: object) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{what}: cannot be written: {error.strerror or error}") from error


def describe_os_error(error: OSError, what: str) -> str:
    """Return one line about an error of a file; `what` names the file where the error does not, as a full disk's."""
    return str(error) if error.filename is not None or not error.strerror else f"{what}: {error.strerror}"


def messages(name: str) -> Callable[[str], None]:
    """Return a function that writes `name: line` to standard error at once."""

    def write(line: str) -> None:
        print_line(f"{name}: {one_line(line)}")

    return write


def command_line(
    name: str, exits: Mapping[type[Exception], int] | None = None
) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Decorate the main function of a command: an output that cannot be written is one line and EXIT_CHECK_FAILED.

    `exits`: exit codes of other errors, by their type; the first that fits counts, its text is the one line. Standard
    output is flushed here, where its error can still be reported. An interrupted command is one line and
    EXIT_INTERRUPTED.
    """
    codes, report = dict(exits or {}), messages(name)

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def run(*args: P.args, **kwargs: P.kwargs) -> int:
            open_missing_streams()
            try:
                try:
                    code = main(*args, **kwargs)
                except tuple(codes) as error:
                    report(str(error))
                    code = next(code for kind, code in codes.items() if isinstance(error, kind))
                except KeyboardInterrupt:
                    report("interrupted")
                    code = EXIT_INTERRUPTED
                with _named("standard output"):
                    sys.stdout.flush()
                return code
            except (OutputError, OSError) as error:
                if isinstance(error, OSError) and error.errno not in (errno.ENOSPC, errno.EPIPE, errno.EBADF):
                    raise
                report(describe_os_error(error, "an output") if isinstance(error, OSError) else str(error))
                _give_up_stdout()
                return EXIT_CHECK_FAILED

        return run

    return decorate


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Yield a list to which the number of every SIGINT and SIGTERM is appended until the block ends."""
    received: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _give_up_stdout() -> None:
    """Let nothing be left for the interpreter to write at its exit when standard output takes nothing more."""
    try:
        sys.stdout.flush()
    except OSError:
        null = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


# Module -> extra of pyproject.toml that installs it.
_EXTRAS: Final = {
    "onnxruntime": "cpu", "cyclonedds": "unitree", "pymavlink": "mavlink", "can": "can", "cantools": "can",
    "torch": "export", "onnx": "export", "onnxscript": "export", "safetensors": "export", "jinja2": "export",
    "pybullet": "sim", "panda3d": "sim", "direct": "sim", "scipy": "sim", "gymnasium": "sim", "matplotlib": "sim",
    "cryptography": "sign", "ray": "cluster", "aiohttp": "live", "prometheus_client": "live",
}  # fmt: skip


def missing_extra(error: ModuleNotFoundError, extra: str = "") -> str | None:
    """Return one line on how to install the missing module; None where no extra has it."""
    name = (error.name or "").partition(".")[0]
    needed = extra or _EXTRAS.get(name, "")
    if name not in _EXTRAS and not extra:
        return None
    also = ", or NVIDIA's onnxruntime-gpu on a Jetson" if name == "onnxruntime" else ""
    also = " (arm64: edge-install dds)" if name == "cyclonedds" else also
    return f"needs the packages of the extra {needed!r} ({name} is missing): pip install 'tic-vla-edge[{needed}]'{also}"


def _print_version(command: str) -> int:
    @command_line(command)
    def print_it() -> int:
        sys.stdout.write(f"{version_line(command)}\n")
        return EXIT_DONE

    return print_it()


def run_with_extra(command: str, module: str, extra: str = "", arguments: str = "") -> int:
    """Run `module.main()`; `--version` needs none of its packages, a missing extra is one line that names it.

    `arguments`: module that checks the command line first, because `module` takes long to load; the errors of its
    `REFUSALS` (default: ValueError and OSError) are one line and EXIT_BAD_INPUT.
    """
    report = messages(command)
    if sys.argv[1:] == ["--version"]:
        return _print_version(command)
    open_missing_streams()
    try:
        if arguments:
            first = importlib.import_module(arguments)
            if sys.argv[1:2] not in [[name] for name in getattr(first, "SUBCOMMANDS", ())]:
                try:
                    first.check(first.parser().parse_args())
                except getattr(first, "REFUSALS", (ValueError, OSError)) as error:
                    report(str(error))
                    return EXIT_BAD_INPUT
        main = importlib.import_module(module).main
        return int(main())
    except ModuleNotFoundError as error:
        line = missing_extra(error, extra)
        if line is None:
            raise
        report(line)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:  # while modules load; afterwards the command answers itself
        report("interrupted")
        return EXIT_INTERRUPTED
