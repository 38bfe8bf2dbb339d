"""Outputs that a user names: regular files are replaced whole, devices, FIFOs and links are never replaced."""

from __future__ import annotations

import ast
import contextlib
import importlib
import json
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import edge.core.cli
import edge.deploy.doctor.command
import edge.signature
import export.cli
import firmware_bridge.bridge
import sim_hil.layouts.__main__
import tools.bench.roofline
import tools.train.cli
from edge import commands
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED, OutputError, write_result
from firmware_bridge.system import output_file

ROOT = Path(__file__).parents[3]
ROBOT = ROOT / "firmware_bridge" / "robots" / "go2.toml"
AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root may make device nodes (CAP_MKNOD)")

Command = Callable[[str, Path], int]


def layouts(where: str, tmp_path: Path) -> int:
    out = str(tmp_path / "scene.toml")
    return sim_hil.layouts.__main__.main(["office", "--seed", "500000", "--out", out, "--json", where])


def keygen(where: str, tmp_path: Path) -> int:
    key = tmp_path / f"key-{len(list(tmp_path.iterdir()))}"
    return edge.signature.main(["keygen", "--key", str(key), "--json", where])


# What each command returns when its output can be written.
COMMANDS: dict[str, tuple[Command, int]] = {
    "edge-bridge": (
        lambda where, tmp: firmware_bridge.bridge.main(
            ["status", "--robot", str(ROBOT), "--socket", str(tmp / "none.sock"), "--json", where]
        ),
        EXIT_REFUSED,
    ),
    "edge-export": (lambda where, _: export.cli.main(["--dry-run", "--model", "nano", "--json", where]), EXIT_DONE),
    "edge-train": (
        lambda where, _: tools.train.cli.main(["all", "--preset", "tiny", "--dry-run", "--json", where]),
        EXIT_DONE,
    ),
    "edge-doctor": (lambda where, _: edge.deploy.doctor.command.main(["--ticks", "0", "--json", where]), EXIT_DONE),
    "signature": (keygen, EXIT_DONE),
    "layouts": (layouts, EXIT_DONE),
    "roofline": (lambda where, _: tools.bench.roofline.main(["--json", where]), EXIT_DONE),
}


@pytest.fixture(params=COMMANDS)
def command(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[Path], tuple[int, int]]:
    """Run one command with an output path; its exit code, and the one expected where all is well."""
    main, good = COMMANDS[request.param]
    return lambda where: (main(str(where), tmp_path), good)


def node(path: Path, minor: int) -> Path:
    """A copy of /dev/null (3) or /dev/full (7): the machine's own is never put at risk."""
    os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, minor))
    return path


@contextlib.contextmanager
def reader(fifo: Path) -> Iterator[list[bytes]]:
    """What is written into a FIFO."""
    found: list[bytes] = []
    thread = threading.Thread(target=lambda: found.append(fifo.read_bytes()), daemon=True)
    thread.start()
    while not threading.Event().wait(0.05):  # until the reader has it open
        with contextlib.suppress(OSError):
            probe = os.open(fifo, os.O_WRONLY | os.O_NONBLOCK)
            break
    yield found
    os.close(probe)
    thread.join(10)


@pytest.mark.slow
@AS_ROOT
def test_a_device_node_stays_a_device_node(command: Callable[[Path], tuple[int, int]], tmp_path: Path) -> None:
    device = node(tmp_path / "null.json", 3)
    code, good = command(device)
    assert code == good
    assert stat.S_ISCHR(device.lstat().st_mode)


@pytest.mark.slow
@AS_ROOT
def test_a_full_device_is_one_line_and_exit_code_1(
    command: Callable[[Path], tuple[int, int]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    device = node(tmp_path / "full.json", 7)
    code, _ = command(device)
    assert code == EXIT_CHECK_FAILED
    lines = [line for line in capfd.readouterr().err.splitlines() if "No space left on device" in line]
    assert len(lines) == 1
    assert stat.S_ISCHR(device.lstat().st_mode)


@pytest.mark.slow
def test_a_fifo_gets_the_result_and_stays(command: Callable[[Path], tuple[int, int]], tmp_path: Path) -> None:
    fifo = tmp_path / "fifo.json"
    os.mkfifo(fifo)
    with reader(fifo) as found:
        code, good = command(fifo)
    assert code == good
    assert isinstance(json.loads(found[0]), dict)
    assert stat.S_ISFIFO(fifo.lstat().st_mode)


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_a_fifo_without_a_reader_is_one_line(
    command: Callable[[Path], tuple[int, int]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fifo = tmp_path / "fifo.json"
    os.mkfifo(fifo)
    code, _ = command(fifo)
    assert code in (EXIT_CHECK_FAILED, EXIT_BAD_INPUT)
    assert sum("no process reads" in line for line in capfd.readouterr().err.splitlines()) == 1
    assert stat.S_ISFIFO(fifo.lstat().st_mode)


@pytest.mark.slow
@pytest.mark.parametrize("exists", [True, False], ids=["to a file", "to a new name"])
def test_a_link_stays_and_leads_to_the_result(
    command: Callable[[Path], tuple[int, int]], tmp_path: Path, exists: bool
) -> None:
    (tmp_path / "real").mkdir()
    target, link = tmp_path / "real" / "result.json", tmp_path / "link.json"
    if exists:
        target.write_text("old")
    link.symlink_to(target)
    code, good = command(link)
    assert code == good
    assert link.is_symlink() and isinstance(json.loads(target.read_text()), dict)
    assert [path.name for path in target.parent.iterdir()] == ["result.json"]


def test_a_directory_is_refused_beforehand(
    command: Callable[[Path], tuple[int, int]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "folder.json"
    folder.mkdir()
    code, _ = command(folder)
    assert code == EXIT_BAD_INPUT
    assert sum("is a directory" in line for line in capfd.readouterr().err.splitlines()) == 1
    assert folder.is_dir()


@pytest.mark.parametrize(("to", "message"), [("none/result.json", "No such file"), ("link", "symbolic links")])
def test_a_link_that_leads_nowhere_is_refused(tmp_path: Path, to: str, message: str) -> None:
    (tmp_path / "link").symlink_to(tmp_path / to)
    with pytest.raises(OutputError, match=message):
        write_result(str(tmp_path / "link"), {})


def test_a_link_where_the_temporary_file_goes_is_not_followed(tmp_path: Path) -> None:
    victim, target = tmp_path / "victim", tmp_path / "result.json"
    victim.write_text("untouched")
    target.touch(0o600)
    output_file.partial_of(target).symlink_to(victim)
    write_result(str(target), {"a": 1})
    assert victim.read_text() == "untouched"
    assert json.loads(target.read_text()) == {"a": 1}
    assert stat.S_IMODE(target.stat().st_mode) == 0o600  # a file keeps its permissions


def test_a_fifo_whose_reader_hangs_does_not_keep_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_file, "READER_S", 0.2)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    hung = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with pytest.raises(OutputError, match="took nothing"):
            write_result(str(fifo), {"a": "x" * 1_000_000})
    finally:
        os.close(hung)


@pytest.mark.parametrize("how", [">", ">>"])
def test_a_link_to_standard_output_is_written_after_what_is_there(tmp_path: Path, how: str) -> None:
    log, link = tmp_path / "log", tmp_path / "stdout"  # as /dev/stdout is: the machine's own is never put at risk
    log.write_text("before\n")
    link.symlink_to("/proc/self/fd/1")
    code = f"from edge.core.cli import write_result; write_result({str(link)!r}, {{'a': 1}})"
    subprocess.run(["sh", "-c", f'"$0" -c "$1" {how} "$2"', sys.executable, code, str(log)], check=True, timeout=300)
    text = log.read_text()
    assert text.startswith("before") == (how == ">>")
    assert json.loads(text.removeprefix("before")) == {"a": 1}
    assert link.is_symlink()


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(("tools.bench.roofline",), marks=pytest.mark.slow, id="tool"),
        pytest.param(("firmware_bridge.bridge", "status", "--robot", str(ROBOT)), id="edge-bridge"),
    ],
)
def test_standard_output_on_a_full_disk_is_one_line_and_exit_code_1(arguments: tuple[str, ...]) -> None:
    with Path("/dev/full").open("wb") as full:  # opened to be written to, never to be replaced
        done = subprocess.run(
            [sys.executable, "-m", *arguments, "--json", "-"],
            stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == EXIT_CHECK_FAILED
    assert "No space left on device" in done.stderr and "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


@AS_ROOT
def test_a_stream_and_a_library_write_through_a_device_too(tmp_path: Path) -> None:
    device = node(tmp_path / "null", 3)
    with edge.core.cli.open_stream(device) as stream:
        stream.write("a line\n")
    with edge.core.cli.named_file(device) as path:
        path.write_bytes(b"weights")
    assert stat.S_ISCHR(device.lstat().st_mode)


def test_a_trace_into_a_fifo_without_a_reader_does_not_wait(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(OSError, match="no process reads"):
        edge.core.cli.open_stream(tmp_path / "fifo")


def modules_with_outputs() -> list[Path]:
    """Every module with a main function and an option that names an output."""
    found = []
    for package in ("edge", "calib", "export", "sim_hil", "tools"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "\ndef main(" in text and ('"--json"' in text or ('metavar="FILE.' in text and '"--out"' in text)):
                found.append(path)
    return found


@pytest.mark.parametrize("path", modules_with_outputs(), ids=lambda p: str(p.relative_to(ROOT)))
def test_every_command_with_outputs_reports_the_ones_that_cannot_be_written(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    (main,) = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "main")
    assert any(isinstance(d, ast.Call) and ast.unparse(d.func) == "command_line" for d in main.decorator_list)


@pytest.mark.parametrize("path", modules_with_outputs(), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_command_writes_to_a_named_output_by_itself(path: Path) -> None:
    """`args.out.write_text`, `Path(args.json).open("w")` and their like."""
    named = {"args.json", "args.map", "args.trace", "args.save_weights", "args.out"}
    for call in (n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)):
        if isinstance(call.func, ast.Attribute) and call.func.attr in ("write_text", "write_bytes", "open"):
            written = call.func.value
            if isinstance(written, ast.Call):  # Path(args.out)
                written = written.args[0]
            assert ast.unparse(written) not in named, ast.unparse(call)


@pytest.mark.parametrize("command", commands.COMMANDS)
def test_every_console_script_is_such_a_command(command: str) -> None:
    assert hasattr(importlib.import_module(commands.COMMANDS[command][0]).main, "__wrapped__")
