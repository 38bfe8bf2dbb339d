"""Exit codes and result files that every command line shares (design §9)."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXIT_DONE = 0
EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_REFUSED = 3
EXIT_INTERRUPTED = 130


def check_result_target(where: str | None) -> None:
    """Refuse, before a long run, a place that its result cannot be written to; raises OSError with one clear line."""
    if where is None or where == "-":
        return
    path = Path(where)
    if not path.name or path.is_dir():
        raise OSError(f"--json {where!r}: expected a file to write or -")
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise OSError(f"--json {where}: {parent} is not a directory that can be written to")


def write_result(where: str | None, result: Mapping[str, Any]) -> None:
    """Write a result as JSON to a file (in one rename) or to standard output for `-`; raises OSError."""
    if where is None:
        return
    text = json.dumps(result, indent=1) + "\n"
    if where == "-":
        sys.stdout.write(text)
        return
    path = Path(where)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text)


def write_whole(path: Path, text: str) -> None:
    """Write a text file in one rename, so that a file that is there is whole; raises OSError and leaves nothing."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def run_with_extra(command: str, module: str, extra: str) -> int:
    """Run `module.main()` of an optional part; without its packages, one line that says how to install them."""
    try:
        main = importlib.import_module(module).main
    except ModuleNotFoundError as error:
        sys.stderr.write(
            f"{command}: needs the packages of the extra {extra!r} ({error.name} is missing): "
            f"pip install 'tic-vla-edge[{extra}]'\n"
        )
        return EXIT_BAD_INPUT
    return int(main())
