"""During an update: power cuts, a full disk, a clock at 1970. A release that starts is always current.

A power cut is SIGKILL of the real process and of all its children. It does not show what a disk loses that it had not
yet written: the plan flushes the disks before it switches, which `test_board.py` checks.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE
from edge.deploy.board import Board
from edge.deploy.releases import read_home
from edge.deploy.steps import Disk
from tests.support.fake_board import Versions, current, starts
from tests.support.processes import REPOSITORY

pytestmark = pytest.mark.process

CUTS: Final = 100
EVENTS: Final = ("os.", "open", "shutil.", "subprocess.Popen")
"""Audit events of Python that come just before an operation on the file system or a child process."""


def in_child(action: Callable[[], int], cut_at: int | None = None, counted: Path | None = None) -> int:
    """Run an action in a forked process of its own group; returns its process id.

    `cut_at`: kill the whole group at the operation of that number. `counted`: write the number of operations there.
    """
    child = os.fork()
    if child:
        with contextlib.suppress(PermissionError, ProcessLookupError):  # it has already run, or ended
            os.setpgid(child, child)
        return child
    os.setpgid(0, 0)
    done = 0

    def count(event: str, _arguments: object) -> None:
        nonlocal done
        if event.startswith(EVENTS):
            done += 1
            if done == cut_at:
                os.killpg(0, signal.SIGKILL)

    sys.addaudithook(count)
    code = action()
    if counted is not None:
        total = done
        counted.write_text(str(total))
    os._exit(code)


def ended(child: int) -> int:
    """Wait for a process; returns its exit code, or minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def cut_after(child: int, delay_s: float) -> int:
    """Kill a process and its children after a delay; returns how it ended."""
    time.sleep(delay_s)
    os.killpg(child, signal.SIGKILL)
    return ended(child)


def wait_for_killed_children(home: Path) -> None:
    """Wait until the last process of a killed group is gone: each keeps the lock while it lives."""
    with (home / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)


@pytest.mark.slow
def test_a_hundred_power_cuts_during_an_update_leave_a_release_that_starts(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    assert versions.install(1) == EXIT_DONE
    started_s = time.monotonic()
    assert ended(in_child(lambda: versions.install(2), counted=tmp_path / "count")) == EXIT_DONE
    whole_s, operations = time.monotonic() - started_s, int((tmp_path / "count").read_text())
    chance, cuts, switched, version = random.Random(0), 0, 0, 2
    while cuts < CUTS:
        before, version = current(versions.home), version + 1
        versions.sources(version)
        at_operation = 1 + cuts * operations // CUTS if cuts % 2 else None
        child = in_child(functools.partial(versions.install, version), at_operation)
        how = ended(child) if at_operation else cut_after(child, chance.uniform(0.05, 0.9) * whole_s)
        cuts += how == -signal.SIGKILL
        assert starts(versions.home), f"cut {cuts}, operation {at_operation}"
        assert current(versions.home) >= before
        switched += how == -signal.SIGKILL and current(versions.home) != before
        # The next call finishes the update and cleans up.
        wait_for_killed_children(versions.home)
        assert versions.install(version) == EXIT_DONE, versions.lines[-1]
        assert starts(versions.home)
        assert len(versions.numbers()) <= 3 and not (versions.home / "current.partial").is_symlink()
    assert 0 < switched < cuts, "every cut came before, or after, the switch"


def test_a_power_cut_at_every_operation_of_the_switch_leaves_a_release_that_starts(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    versions.install(2)
    found = set()
    for number in range(1, 100):
        child = in_child(lambda: Disk().point(versions.home / "current", Path("releases/1")) or 0, cut_at=number)  # type: ignore[func-returns-value]
        how = ended(child)
        assert starts(versions.home)
        found.add(current(versions.home))
        Disk().point(versions.home / "current", Path("releases/2"))
        if how == 0:
            break
    assert found == {1, 2} and how == 0


@pytest.mark.slow
def test_a_power_cut_at_every_operation_of_a_rollback_leaves_a_release_that_starts(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    versions.install(2)
    number, how = 0, -1
    while how != EXIT_DONE:
        number += 1
        how = ended(in_child(lambda: versions.call("rollback", "--to", "1"), cut_at=number))
        assert starts(versions.home)
        wait_for_killed_children(versions.home)
        assert versions.call("rollback", "--to", "2") == EXIT_DONE
    assert number > 10


def test_a_removal_that_is_cut_off_leaves_no_release_that_claims_to_be_whole(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    versions.install(2)

    class CutDisk(Disk):
        def remove_tree(self, path: Path) -> None:
            (path / "venv/lib/module0").unlink()
            os.killpg(0, signal.SIGKILL)

    def prune() -> int:
        versions.board = Board(python=versions.board.python, machine="x86_64", disk=CutDisk())
        return versions.install(3, "--keep", "1")

    assert ended(in_child(prune)) == -signal.SIGKILL
    assert current(versions.home) == 3 and starts(versions.home)
    assert [release.number for release in read_home(versions.home).releases] == [2, 3]
    assert versions.call("rollback", "--to", "1") == EXIT_CHECK_FAILED
    assert versions.call("rollback") == EXIT_DONE and starts(versions.home)


# --- a full disk


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MB, of which the first release takes a quarter."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=1M", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(words, capture_output=True, check=False).returncode != 0:
        pytest.skip("needs the right to mount a small disk")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.mark.parametrize("free_kb", [0, 40, 90, 110, 150, 200])
def test_a_full_disk_leaves_the_old_release_and_nothing_of_the_new(
    small_disk: Path, tmp_path: Path, free_kb: int
) -> None:
    versions = Versions(tmp_path, small_disk / "home")
    assert versions.install(1) == EXIT_DONE
    versions.sources(2)
    filled = shutil.disk_usage(small_disk).free - free_kb * 1000
    (small_disk / "filler").write_bytes(bytes(filled))
    assert versions.install(2) == EXIT_CHECK_FAILED
    assert "the disk is full" in versions.lines[-1] and "release 1 is current" in versions.lines[-1]
    assert versions.numbers() == [1] and current(versions.home) == 1 and starts(versions.home)
    (small_disk / "filler").unlink()
    assert versions.install(2) == EXIT_DONE and starts(versions.home)


def test_a_file_above_the_allowed_size_leaves_the_old_release(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    versions.sources(2)

    def limited() -> int:
        sys.dont_write_bytecode = True  # Python leaves a .pyc that was cut off by the limit
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
        return versions.install(2)

    assert ended(in_child(limited)) == EXIT_CHECK_FAILED
    assert versions.numbers() == [1] and starts(versions.home)


# --- a clock that starts in 1970


def test_the_order_of_releases_does_not_depend_on_times_of_files(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    for version in (1, 2, 3, 4):
        versions.install(version, "--keep", "2")
        for path in (versions.home / f"releases/{version}").rglob("*"):
            os.utime(path, (100 - version, 100 - version))  # each release looks older than the one before it
    assert versions.numbers() == [2, 3, 4] and current(versions.home) == 4
    assert versions.call("rollback") == EXIT_DONE and current(versions.home) == 3


CLOCK = """
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
#include <sys/syscall.h>
time_t time(time_t *t) { if (t) *t = 42; return 42; }
int gettimeofday(struct timeval *v, void *z) { v->tv_sec = 42; v->tv_usec = 0; return 0; }
int clock_gettime(clockid_t id, struct timespec *s) {
    if (id == CLOCK_REALTIME) { s->tv_sec = 42; s->tv_nsec = 0; return 0; }
    return syscall(SYS_clock_gettime, id, s);
}
"""
"""The C library's clock, 42 s after the epoch."""

UPDATE = """
import datetime, sys
from pathlib import Path
from tests.support.fake_board import Versions
assert datetime.datetime.now(datetime.timezone.utc).year == 1970
versions = Versions(Path(sys.argv[1]))
code = versions.install(2) or versions.call("rollback") or versions.call("rollback", "--to", "2")
print("\\n".join(versions.lines))
sys.exit(code)
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a compiler for a clock of 1970")
def test_update_and_rollback_work_with_the_clock_at_1970(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    (tmp_path / "clock.c").write_text(CLOCK)
    library = tmp_path / "clock.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, tmp_path / "clock.c"], check=True)
    environment = {**os.environ, "LD_PRELOAD": str(library), "PYTHONPATH": str(REPOSITORY)}
    words = [sys.executable, "-c", UPDATE, tmp_path]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert current(versions.home) == 2 and starts(versions.home)
