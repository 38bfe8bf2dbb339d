"""`edge-install board`, `rollback`, `releases` and `remove`: what each leaves on the disk, and what it refuses."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, EXIT_REFUSED
from edge.deploy.board import Board
from edge.deploy.install import main
from edge.deploy.releases import Contents, Home, Layout, Release, ReleaseError, read_home
from edge.deploy.steps import Disk
from tests.support.fake_board import (
    Versions,
    commands_of,
    current,
    install,
    starts,
    write_wheel,
)
from tests.support.processes import REPOSITORY


@pytest.fixture
def versions(tmp_path: Path) -> Versions:
    return Versions(tmp_path)


def tree(folder: Path) -> dict[str, bytes | str | None]:
    """Return every path below a folder with its content or its link's target."""
    found: dict[str, bytes | str | None] = {}
    for path in folder.rglob("*"):
        content = path.read_bytes() if path.is_file() else None
        found[str(path.relative_to(folder))] = str(path.readlink()) if path.is_symlink() else content
    return found


# --- install and update


def test_the_first_install_makes_a_current_release_that_starts(versions: Versions) -> None:
    assert versions.install(1) == EXIT_DONE
    assert current(versions.home) == 1 and starts(versions.home)


def test_an_update_keeps_the_old_release_and_uses_the_new_one(versions: Versions) -> None:
    versions.install(1)
    assert versions.install(2) == EXIT_DONE
    assert current(versions.home) == 2 and versions.numbers() == [1, 2] and starts(versions.home)


def test_a_second_install_of_the_same_changes_nothing(versions: Versions) -> None:
    versions.install(1)
    before = tree(versions.home)
    assert versions.install(1) == EXIT_DONE
    assert tree(versions.home) == before and commands_of(versions.lines) == []


def test_other_artifacts_with_the_same_wheel_are_an_update(versions: Versions) -> None:
    wheel, artifacts = versions.sources(1)
    install(versions.home, versions.board, versions.lines, wheel, artifacts)
    install(versions.home, versions.board, versions.lines, wheel, versions.sources(2)[1])
    assert current(versions.home) == 2


def test_a_release_that_is_kept_is_switched_to_and_not_built_again(versions: Versions) -> None:
    versions.install(1)
    versions.install(2)
    versions.call("rollback")
    assert versions.install(2) == EXIT_DONE
    assert current(versions.home) == 2 and not any("pip" in line for line in versions.lines)


def test_every_step_is_printed_with_its_number(versions: Versions) -> None:
    versions.install(1)
    steps = [line for line in versions.lines if line.startswith("step ")]
    assert [line.split(":")[0] for line in steps] == [f"step {n} of {len(steps)}" for n in range(1, len(steps) + 1)]


def test_the_switch_comes_after_every_check_the_flush_and_the_record(versions: Versions) -> None:
    versions.install(1)
    words = [text.split()[0] for text in commands_of(versions.lines)]
    assert words.index("switch") == len(words) - 1
    assert words[-3:] == ["flush", "write", "switch"] and words.count("check:") == 3


def test_a_dry_run_prints_the_steps_of_the_real_run_and_changes_nothing(versions: Versions) -> None:
    assert versions.install(1, "--dry-run") == EXIT_DONE
    planned = commands_of(versions.lines)
    assert not versions.home.exists()
    versions.install(1)
    assert commands_of(versions.lines) == planned


def test_releases_older_than_the_kept_ones_are_removed(versions: Versions) -> None:
    for version in range(1, 6):
        versions.install(version, "--keep", "2")
    assert versions.numbers() == [3, 4, 5]


def test_services_can_read_what_root_installs_with_a_narrow_umask(versions: Versions) -> None:
    before = os.umask(0o077)
    try:
        versions.install(1)
    finally:
        os.umask(before)
    closed = [path for path in versions.home.rglob("*") if not path.is_symlink() and not path.stat().st_mode & 0o004]
    assert not closed


def test_the_operator_reads_how_to_restart_to_go_back_and_to_undo(versions: Versions) -> None:
    versions.install(1)
    text = "\n".join(versions.lines)
    assert "systemctl restart tic-vla-edge-bridge" in text and "edge-install rollback" in text
    assert "edge-install remove" in text


# --- commands that pip and the new release get


class Recorded:
    """Runs nothing; records the commands."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []

    def __call__(self, _lock: int, words: Sequence[str]) -> tuple[int, str]:
        self.commands.append(list(words))
        return 0, ""

    @property
    def pip(self) -> list[str]:
        return next(words[5:] for words in self.commands if "pip" in words)


def record(versions: Versions, machine: str, *more: str) -> Recorded:
    recorded = Recorded()
    versions.board = Board(python="python3", machine=machine, run=recorded)
    assert versions.install(1, *more) == EXIT_DONE
    return recorded


def test_on_x86_64_the_extra_unitree_brings_the_binding_by_pip(versions: Versions) -> None:
    recorded = record(versions, "x86_64", "--extras", "unitree,cpu")
    assert recorded.pip == [f"{versions.sources(1)[0]}[cpu,unitree]"]
    assert not any(words[-1] == "dds" for words in recorded.commands)


def test_on_arm64_the_extra_unitree_is_edge_install_dds(versions: Versions) -> None:
    recorded = record(versions, "aarch64", "--extras", "cpu,unitree")
    assert recorded.pip == [f"{versions.sources(1)[0]}[cpu]"]
    assert [str(versions.home / "releases/1/venv/bin/edge-install"), "dds"] in recorded.commands


def test_a_jetson_gets_the_gpu_build_instead_of_the_extra_cpu(versions: Versions) -> None:
    url = "https://example.org/simple/"
    recorded = record(versions, "aarch64", "--extras", "", "--with", "onnxruntime-gpu", "--index", url)
    assert recorded.pip == ["--extra-index-url", url, str(versions.sources(1)[0]), "onnxruntime-gpu"]


def test_without_a_network_pip_reads_a_folder_of_wheels_only(versions: Versions) -> None:
    recorded = record(versions, "x86_64", "--wheels", str(versions.folder))
    assert recorded.pip[:3] == ["--no-index", "--find-links", str(versions.folder)]


def test_artifacts_are_verified_by_the_new_release_s_own_program(versions: Versions) -> None:
    recorded = record(versions, "x86_64")
    release = versions.home / "releases/1"
    assert [f"{release}/venv/bin/edge-install", "engines", "--artifacts", f"{release}/artifacts"] in recorded.commands


# --- what is refused


@pytest.fixture
def installed(versions: Versions) -> Iterator[Versions]:
    """Release 1; what a test tries after it must leave it as it was."""
    versions.install(1)
    before = tree(versions.home)
    yield versions
    after = tree(versions.home)
    after.pop("install.log", None)
    assert after == before and starts(versions.home)


def test_half_copied_artifacts_are_refused_and_nothing_of_them_stays(installed: Versions) -> None:
    _, artifacts = installed.sources(2)
    os.truncate(artifacts / "graph.onnx", 5_000)
    assert installed.install(2) == EXIT_REFUSED
    assert "a hash differs" in installed.lines[-1] and "release 1 is current" in installed.lines[-1]


def test_a_manifest_that_was_not_copied_is_refused(installed: Versions) -> None:
    _, artifacts = installed.sources(2)
    (artifacts / "manifest.json").unlink()
    assert installed.install(2) == EXIT_REFUSED


def test_a_half_copied_wheel_is_refused_before_anything_is_done(installed: Versions) -> None:
    wheel, artifacts = installed.sources(2)
    os.truncate(wheel, wheel.stat().st_size // 2)
    assert install(installed.home, installed.board, installed.lines, wheel, artifacts) == EXIT_BAD_INPUT
    assert "not a whole wheel" in installed.lines[-1] and "copy it again" in installed.lines[-1]


def test_a_wheel_of_another_package_is_refused(installed: Versions) -> None:
    wheel = write_wheel(installed.folder / "other", "0.1.0", name="another")
    code = install(installed.home, installed.board, installed.lines, wheel, installed.sources(2)[1])
    assert code == EXIT_BAD_INPUT and "found another" in installed.lines[-1]


def test_an_extra_that_the_wheel_does_not_have_is_refused(installed: Versions) -> None:
    assert installed.install(2, "--extras", "cpu,jetson") == EXIT_BAD_INPUT
    assert "--extras jetson" in installed.lines[-1]


def test_a_release_without_onnx_runtime_never_becomes_current(installed: Versions) -> None:
    def run(_lock: int, words: Sequence[str]) -> tuple[int, str]:
        fails = words[-1] == "import onnxruntime"
        return (1, "ModuleNotFoundError: No module named 'onnxruntime'") if fails else (0, "")

    installed.board = Board(python="python3", machine="x86_64", run=run)
    assert installed.install(2) == EXIT_CHECK_FAILED
    assert "give --extras cpu" in installed.lines[-1]


def test_a_certificate_error_in_1970_says_to_set_the_clock(installed: Versions) -> None:
    def run(_lock: int, words: Sequence[str]) -> tuple[int, str]:
        return (1, "SSLError: certificate verify failed: certificate is not yet valid") if "pip" in words else (0, "")

    installed.board = Board(python="python3", machine="x86_64", run=run)
    assert installed.install(2) == EXIT_CHECK_FAILED
    assert "the clock is wrong" in installed.lines[-1] and "--wheels" in installed.lines[-1]


def test_a_second_call_at_the_same_time_is_refused(installed: Versions) -> None:
    lock = subprocess.Popen(["flock", installed.home / "lock", "sh", "-c", "echo locked; read _"], stdin=-1, stdout=-1)
    try:
        assert lock.stdout is not None and lock.stdout.readline() == b"locked\n"
        assert installed.install(2) == EXIT_CHECK_FAILED
        assert "another edge-install" in installed.lines[-1]
    finally:
        lock.communicate(b"\n")


# --- rollback, releases, remove


def test_rollback_returns_to_the_release_that_was_used_before(versions: Versions) -> None:
    versions.install(1)
    versions.install(2)
    versions.call("rollback")
    versions.install(3)
    assert versions.call("rollback") == EXIT_DONE
    assert current(versions.home) == 1  # not 2, which was rolled back from


def test_rollback_to_a_number_goes_there(versions: Versions) -> None:
    for version in (1, 2, 3):
        versions.install(version)
    assert versions.call("rollback", "--to", "1") == EXIT_DONE and current(versions.home) == 1


def test_rollback_without_an_older_release_names_the_ones_there_are(versions: Versions) -> None:
    versions.install(1)
    assert versions.call("rollback") == EXIT_CHECK_FAILED
    assert "there are: 1" in versions.lines[-1] and current(versions.home) == 1


def test_rollback_to_a_release_that_does_not_start_is_refused(versions: Versions) -> None:
    versions.install(1)
    versions.install(2)
    (versions.home / "releases/1/venv/lib/module0").write_text("broken")
    assert versions.call("rollback") == EXIT_CHECK_FAILED
    assert current(versions.home) == 2


def test_releases_lists_all_and_marks_the_current_one(versions: Versions, tmp_path: Path) -> None:
    versions.install(1)
    versions.install(2)
    assert versions.call("releases", "--json", str(tmp_path / "list.json")) == EXIT_DONE
    assert [line.endswith("(current)") for line in versions.lines] == [False, True]
    assert json.loads((tmp_path / "list.json").read_text()) == {"current": 2, "releases": [1, 2], "unfinished": []}


def test_remove_leaves_nothing_of_board_and_everything_of_the_user(versions: Versions) -> None:
    versions.install(1)
    versions.install(2)
    (versions.home / "go2.toml").write_text("mine")
    assert versions.call("remove", "--dry-run") == EXIT_DONE and starts(versions.home)
    assert versions.call("remove") == EXIT_DONE
    assert tree(versions.home) == {"go2.toml": b"mine"}


def test_remove_where_nothing_was_installed_is_one_line(versions: Versions) -> None:
    assert versions.call("remove") == EXIT_BAD_INPUT
    assert len(versions.lines) == 1 and not versions.home.exists()


class Interrupted(Disk):
    """Ctrl-C at the first folder that is to be removed."""

    def remove_tree(self, folder: Path) -> None:
        raise KeyboardInterrupt


def test_an_interrupted_call_says_which_release_is_current_now(versions: Versions) -> None:
    for version in (1, 2):
        versions.install(version)
    versions.board = replace(versions.board, disk=Interrupted())
    assert versions.install(3, "--keep", "1") == EXIT_INTERRUPTED
    assert current(versions.home) == 3 and versions.lines[-1] == "interrupted; release 3 is current, run it again"
    assert versions.call("remove") == EXIT_INTERRUPTED
    assert versions.lines[-1] == "interrupted; no release is current, run it again"


# --- properties of the order

CONTENTS = Contents("a.whl", "0", "0", (), ())


@st.composite
def homes(draw: st.DrawFn) -> Home:
    numbers = sorted(draw(st.sets(st.integers(1, 30), min_size=1, max_size=8)))
    releases = [Release(n, CONTENTS, draw(st.none() | st.integers(1, 30))) for n in numbers]
    unfinished = draw(st.sets(st.integers(1, 30).filter(lambda n: n not in numbers), max_size=3))
    return Home(Layout(Path("/x")), tuple(releases), tuple(sorted(unfinished)), draw(st.sampled_from(numbers)))


@pytest.mark.slow
@given(homes())
def test_a_new_number_is_above_every_other(home: Home) -> None:
    assert home.next_number() > max([*(release.number for release in home.releases), *home.unfinished])


@pytest.mark.slow
@given(homes(), st.none() | st.integers(1, 30), st.integers(1, 5))
def test_pruning_never_removes_the_current_or_the_previous_release(home: Home, previous: int | None, keep: int) -> None:
    assert home.current is not None
    removed = home.to_prune(home.current, previous, keep)
    assert home.current not in removed and previous not in removed


@pytest.mark.slow
@given(homes(), st.none() | st.integers(1, 30), st.integers(1, 5))
def test_pruning_leaves_at_most_as_many_as_asked_for(home: Home, previous: int | None, keep: int) -> None:
    assert home.current is not None
    assert len(home.releases) - len(home.to_prune(home.current, previous, keep)) <= keep + 1


@given(homes())
def test_rollback_never_goes_to_the_current_release_unless_its_own_record_says_so(home: Home) -> None:
    now = home.find(home.current)
    assert now is not None
    try:
        target = home.rollback_target(None).number
    except ReleaseError:
        assert all(release.number >= now.number for release in home.releases)
        return
    assert target == now.previous or target < now.number


def test_a_release_survives_its_own_record(tmp_path: Path) -> None:
    release = Release(7, Contents("w.whl", "ab", "cd", ("cpu",), ("x==1",)), 5)
    folder = tmp_path / "releases/7"
    folder.mkdir(parents=True)
    Disk().write(folder / "release.json", release.text())
    assert read_home(tmp_path).releases == (release,)


# --- the real pip, the real artifacts


@pytest.mark.slow
@pytest.mark.timeout(600)  # pip downloads and unpacks beside the tests of processes
def test_the_real_command_installs_this_package_whose_programs_start_and_check_artifacts(
    artifacts_dir: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_COMPILE", "0")  # pip's way to say --no-compile: most modules are never loaded here
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "-q", "--no-deps", "-w", tmp_path]
    subprocess.run([*pip, "--no-build-isolation", REPOSITORY], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    words = ["--home", str(tmp_path / "home"), "--wheel", str(wheel), "--artifacts", str(artifacts_dir)]
    code = main(["board", *words])
    output = capfd.readouterr().err
    if code != EXIT_DONE and "name resolution" in output:
        pytest.skip("no package index here")
    assert code == EXIT_DONE, output
    program = [tmp_path / "home/current/venv/bin/edge-run", "--version"]
    assert b"artifact schema" in subprocess.run(program, capture_output=True, check=True, cwd="/").stdout
    broken = tmp_path / "broken"
    shutil.copytree(artifacts_dir, broken)
    largest = max(broken.iterdir(), key=lambda path: path.stat().st_size)
    os.truncate(largest, largest.stat().st_size // 2)
    check = [tmp_path / "home/current/venv/bin/edge-install", "engines", "--artifacts", broken]
    checked = subprocess.run(check, capture_output=True, check=False, cwd="/")
    assert checked.returncode == EXIT_REFUSED and largest.name.encode() in checked.stderr
