"""Runs cases of commands: imports a command once, then forks for each case. Run as a program, cases on standard input.

What a case imports is imported here after it, so that the cases after it find it loaded.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import resource
import selectors
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any, Final, NoReturn, TextIO

MEMORY_BYTES: Final = 6 << 30
SMALL_FILE_BYTES: Final = 1
_CAPABILITY_VERSION: Final = 0x20080522
KEPT_BYTES: Final = 20_000


def main() -> None:
    """Read (module, function, cases) as a line of JSON; write one JSON answer a line, in the order of the cases."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # modules that print when they are loaded
    for line in sys.stdin:
        order = json.loads(line)
        function = getattr(importlib.import_module(order["module"]), order["function"])
        for case in order["cases"]:
            with tempfile.TemporaryFile("w+", encoding="utf-8") as modules:
                answers.write(json.dumps(_answer(function, case, modules)) + "\n")
                answers.flush()
                modules.seek(0)
                for module in modules.read().split():
                    with contextlib.suppress(ImportError):  # not all of them are files
                        importlib.import_module(module)


def _answer(function: Any, case: dict[str, Any], modules: TextIO) -> dict[str, Any]:
    out, err = os.pipe(), os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _be(function, case, out[1], err[1], modules)
    os.close(out[1])
    os.close(err[1])
    until = started + case["limit_s"]
    texts, hung = _read(out[0], err[0], until)
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
        if time.monotonic() > until:
            hung = True
            break
        time.sleep(0.002)
    # Whatever the command has started is in its session.
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    status = ended[1] if ended[0] else os.waitpid(child, 0)[1]
    code = None if hung else os.waitstatus_to_exitcode(status)
    return {"code": code, "out": texts[0], "err": texts[1], "s": time.monotonic() - started}


def _read(out: int, err: int, until: float) -> tuple[list[str], bool]:
    """Read both pipes to their ends, or until a time; what a closed end leaves open counts as hung."""
    found = {out: b"", err: b""}
    with selectors.DefaultSelector() as waiting:
        for each in found:
            waiting.register(each, selectors.EVENT_READ)
        while waiting.get_map() and (left := until - time.monotonic()) > 0:
            for key, _ in waiting.select(min(left, 0.5)):
                data = os.read(key.fd, 65_536)
                found[key.fd] = (found[key.fd] + data)[: 10 * KEPT_BYTES]
                if not data:
                    waiting.unregister(key.fd)
        hung = bool(waiting.get_map())
    for each in found:
        os.close(each)
    return [text.decode("utf-8", "replace") for text in found.values()], hung


def _be(function: Any, case: dict[str, Any], out: int, err: int, modules: TextIO) -> NoReturn:
    code, loaded = 99, set(sys.modules)
    try:
        os.setsid()
        folder = Path(case["cwd"])
        os.chdir(folder)
        os.environ.update({"HOME": str(folder), "TMPDIR": str(folder), "XDG_RUNTIME_DIR": str(folder)})
        os.environ.pop("XDG_CACHE_HOME", None)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(os.open(case["stdout"], os.O_WRONLY) if case["stdout"] else out, 1)
        os.dup2(err, 2)
        os.close(out)
        os.close(err)
        sys.stdin = open(0, encoding="utf-8")  # noqa: SIM115
        sys.stdout = os.fdopen(1, "w", encoding="utf-8")
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace")
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        if case["small_files"]:
            _write_no_bytecode()
            resource.setrlimit(resource.RLIMIT_FSIZE, (SMALL_FILE_BYTES, SMALL_FILE_BYTES))
        if case["unprivileged"]:
            _drop_capabilities()
        sys.argv = [case["program"], *case["argv"]]
        try:
            code = int(function())
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
        sys.stdout.flush()
    except BaseException:  # noqa: BLE001  # judged by the harness, from the traceback
        traceback.print_exc()
        code = 99
    finally:
        try:
            sys.stderr.flush()
            if not case["small_files"]:
                print(*(name for name in sys.modules if name not in loaded), file=modules, flush=True)
        finally:
            os._exit(code)


def _write_no_bytecode() -> None:
    """Keep this process and its children from writing .pyc files: Python leaves one that was cut off by the limit."""
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"


def _drop_capabilities() -> None:
    """Take root's right to read and write what its permissions forbid; root keeps its files."""
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    nothing = (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(header, nothing) != 0:
        raise OSError(ctypes.get_errno(), "capset")


if __name__ == "__main__":
    main()
