"""`edge-install dds`: what is run for which machine, and what a user reads when something is missing or fails."""

from __future__ import annotations

import argparse
import hashlib
import http.server
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from edge.deploy import dds_binding
from edge.deploy.dds_binding import BINDING, BINDING_SHA256, WHEEL, BindingError, System, explained, fetch

MULTIARCH = "aarch64-linux-gnu"


class Machine:
    """A machine whose binding works once it was installed; records the commands."""

    def __init__(self, root: Path, works: bool = False, fails_with: str = "") -> None:
        self.commands: list[list[str]] = []
        self.environments: list[Mapping[str, str]] = []
        self.works, self._fails_with = works, fails_with
        header = root / "include/python3.11/Python.h"
        header.parent.mkdir(parents=True, exist_ok=True)
        header.touch()
        self.system = System(
            "python", "aarch64", (root,), MULTIARCH, header, dict.fromkeys(("gcc", "cmake", "make"), "x")
        )

    def run(self, words: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
        if words[1] == "-c":
            return (0, "0.10.5\n") if self.works else (1, "ModuleNotFoundError: No module named 'cyclonedds'")
        self.commands.append(list(words))
        self.environments.append(environment)
        is_binding = "--no-build-isolation" in words or WHEEL in words
        if is_binding and self._fails_with:
            return 1, self._fails_with
        self.works = self.works or is_binding
        return 0, ""


def install_library(root: Path, version: str = "0.10.2") -> None:
    """Lay out the C library as Debian's packages do."""
    for name in (
        "bin/idlc",
        "include/dds/dds.h",
        f"lib/{MULTIARCH}/libcycloneddsidl.so",
        f"lib/{MULTIARCH}/libddsc.so.{version}",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    (root / f"lib/{MULTIARCH}/libddsc.so").symlink_to(f"libddsc.so.{version}")


def install(
    machine: Machine, tmp_path: Path, system: System | None = None, dry_run: bool = False
) -> tuple[int, list[str]]:
    lines: list[str] = []
    parser = argparse.ArgumentParser()
    dds_binding.add_arguments(parser)
    args = parser.parse_args(["--prefix", str(tmp_path / "prefix"), *(["--dry-run"] if dry_run else [])])
    return dds_binding.run(args, lines.append, system or machine.system, machine.run), lines


def test_a_machine_that_has_a_binding_is_left_alone(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr", works=True)
    assert install(machine, tmp_path) == (0, ["cyclonedds 0.10.5 works; nothing to do"])
    assert machine.commands == []


def test_x86_64_installs_the_wheel(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr")
    code, _ = install(machine, tmp_path, replace(machine.system, machine="x86_64"))
    assert code == 0 and machine.commands[0][-1] == WHEEL


def test_arm64_compiles_the_pinned_source_against_the_packages(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr")
    install_library(tmp_path / "usr")
    code, lines = install(machine, tmp_path)
    assert code == 0 and lines[-1] == "cyclonedds 0.10.5 works"
    assert (tmp_path / "prefix.requirement.txt").read_text() == f"{BINDING} --hash=sha256:{BINDING_SHA256}\n"
    assert machine.environments[1]["CYCLONEDDS_HOME"] == str(tmp_path / "prefix")
    assert str(tmp_path / "prefix/lib") in machine.environments[1]["LDFLAGS"]
    assert (tmp_path / "prefix/lib/libddsc.so").resolve().name == "libddsc.so.0.10.2"


def test_what_another_release_has_compiled_is_not_taken_from_pips_cache(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr")
    install_library(tmp_path / "usr")
    install(machine, tmp_path)
    (compiled,) = [words for words in machine.commands if "--no-build-isolation" in words]
    assert "--no-cache-dir" in compiled  # its path to the C library is compiled in


def test_a_second_call_after_a_broken_one_continues(tmp_path: Path) -> None:
    install_library(tmp_path / "usr")
    assert install(Machine(tmp_path / "usr", fails_with="error: x"), tmp_path)[0] == 1
    assert install(Machine(tmp_path / "usr"), tmp_path)[0] == 0


def test_a_dry_run_changes_nothing(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr")
    install_library(tmp_path / "usr")
    code, lines = install(machine, tmp_path, dry_run=True)
    assert code == 0 and machine.commands == [] and not (tmp_path / "prefix").exists()
    assert len([line for line in lines if line.startswith("step ")]) == 5


@pytest.mark.parametrize(
    ("output", "advice"),
    [
        ("fatal error: Python.h: No such file or directory", "apt-get install python3-dev"),
        ("error: command 'gcc' failed: No such file or directory", "apt-get install gcc"),
        ("ERROR: THESE PACKAGES DO NOT MATCH THE HASHES", "not the pinned one"),
        ("OSError: [Errno 28] No space left on device", "disk is full"),
        ("x.c:1:2: error: unknown type name 'dds_x'\n1 error generated.", "unknown type name"),
    ],
)
def test_a_failed_build_is_explained(output: str, advice: str, tmp_path: Path) -> None:
    install_library(tmp_path / "usr")
    code, lines = install(Machine(tmp_path / "usr", fails_with=output), tmp_path)
    assert code == 1 and (tmp_path / "prefix.log").read_text() == output
    assert advice in lines[-1] or advice in explained(output.splitlines()[0])


def test_missing_headers_are_one_line_that_names_the_package(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "usr")
    install_library(tmp_path / "usr")
    code, lines = install(machine, tmp_path, replace(machine.system, python_header=tmp_path / "none/Python.h"))
    assert code == 1 and "apt-get install python3-dev" in lines[-1] and machine.commands == []


class Server(http.server.BaseHTTPRequestHandler):
    """Serves `CONTENT`, from the asked offset on."""

    CONTENT = bytes(range(256)) * 400
    ranges: list[str | None] = []  # noqa: RUF012 - shared with the test on purpose

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        self.ranges.append(asked)
        offset = int(asked.removeprefix("bytes=").rstrip("-")) if asked else 0
        self.send_response(206 if asked else 200)
        self.end_headers()
        self.wfile.write(self.CONTENT[offset:])

    def log_message(self, *_: object) -> None:
        """Stay silent."""


@pytest.fixture
def url() -> Iterator[str]:
    Server.ranges.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/x.tar.gz"
        server.shutdown()


class TestDownload:
    SHA256 = hashlib.sha256(Server.CONTENT).hexdigest()

    def test_an_interrupted_download_continues(self, url: str, tmp_path: Path) -> None:
        (tmp_path / "x.tar.gz.part").write_bytes(Server.CONTENT[:1000])
        fetch(tmp_path / "x.tar.gz", False, url, self.SHA256)
        assert (tmp_path / "x.tar.gz").read_bytes() == Server.CONTENT and Server.ranges == ["bytes=1000-"]

    def test_an_archive_with_another_hash_is_refused_and_removed(self, url: str, tmp_path: Path) -> None:
        with pytest.raises(BindingError, match="expected SHA-256"):
            fetch(tmp_path / "x.tar.gz", False, url, "0" * 64)
        assert list(tmp_path.iterdir()) == []

    def test_a_given_archive_with_another_hash_is_refused_and_kept(self, tmp_path: Path) -> None:
        (tmp_path / "x.tar.gz").write_bytes(b"another")
        with pytest.raises(BindingError, match="expected SHA-256"):
            fetch(tmp_path / "x.tar.gz", True)
        assert (tmp_path / "x.tar.gz").exists()
