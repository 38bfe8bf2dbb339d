"""What systemd itself says of the units: keys, exposure, users; and the rights and the writing of the units' files."""

from __future__ import annotations

import errno
import shutil
import subprocess
from pathlib import Path

import pytest

from edge.core.cli import OutputError
from edge.core.device import CUDA
from edge.deploy.unit_check import MAX_EXPOSURE, UnitVerdict, check_units, systemd_version
from edge.deploy.unit_files import check_writers, unreadable, write_units
from edge.deploy.unit_text import ServiceUsers, UnitError, sysusers
from edge.deploy.units import (
    BRIDGE_UNIT,
    FIREWALL_UNIT,
    RUNNER_UNIT,
    ServiceInputs,
    bridge_unit,
    firewall_unit,
    runner_unit,
)
from edge.inference.graph import CPU_PROVIDER
from tests.edge.deploy.test_units import inputs

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


def written(folder: Path, service: ServiceInputs) -> list[Path]:
    paths = [folder / BRIDGE_UNIT, folder / RUNNER_UNIT, folder / FIREWALL_UNIT]
    for path, text in zip(paths, (bridge_unit(service), runner_unit(service), firewall_unit(service)), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def programs(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("edge-bridge", "edge-run"):
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(0o755)
    return folder


@needs_systemd
@pytest.mark.parametrize("folder", ["bin", "two words", "100%n", "$HOME", "a;b", "ü"])
def test_systemd_finds_the_programs_in_a_folder_of_any_name(tmp_path: Path, folder: str) -> None:
    found = programs(tmp_path / folder)
    paths = written(tmp_path, inputs(programs=found, python=found / "edge-run"))
    assert check_units(paths).complaints == ()
    (found / "edge-bridge").unlink()
    assert any("edge-bridge" in line for line in check_units(paths).complaints)


@needs_systemd
def test_systemd_complains_about_a_key_that_it_does_not_know(tmp_path: Path) -> None:
    paths = written(tmp_path, inputs(programs=programs(tmp_path / "bin")))
    paths[0].write_text(paths[0].read_text().replace("WatchdogSec", "WatchdogSeconds"))
    assert not check_units(paths).good


@needs_systemd
@pytest.mark.parametrize("providers", [(CPU_PROVIDER,), (CUDA,)])
def test_no_service_is_more_exposed_than_promised(tmp_path: Path, providers: tuple[str, ...]) -> None:
    service = inputs(
        programs=programs(tmp_path / "bin"), providers=providers, devices=(Path("/dev/nvmap"),), groups=("video",)
    )
    verdict = check_units(written(tmp_path, service))
    assert set(verdict.exposure) == {BRIDGE_UNIT, RUNNER_UNIT, FIREWALL_UNIT}
    assert verdict.good, verdict
    (tmp_path / BRIDGE_UNIT).write_text(f"[Service]\nExecStart={tmp_path / 'bin' / 'edge-bridge'}\n")
    exposed = check_units([tmp_path / BRIDGE_UNIT])
    assert exposed.exposure[BRIDGE_UNIT] > MAX_EXPOSURE and not exposed.good


@needs_systemd
def test_this_machines_systemd_knows_every_key_of_the_bridges_restarts(tmp_path: Path) -> None:
    service = inputs(programs=programs(tmp_path / "bin"), systemd=systemd_version())
    assert check_units(written(tmp_path, service)).complaints == ()


@pytest.mark.parametrize(
    ("answer", "version"),
    [
        ((0, "systemd 252 (252.38-1~deb12u1)\n+PAM"), 252),
        ((0, "systemd 255.4 (255.4-1ubuntu8)\n"), 255),
        ((1, ""), None),
        ((0, "nothing of the kind"), None),
    ],
)
def test_systemds_version_is_read(answer: tuple[int, str], version: int | None) -> None:
    assert systemd_version(run=lambda _command: answer, which=lambda name: name) == version
    assert systemd_version(which=lambda _name: None) is None


def test_without_systemd_the_verdict_reports_that_nothing_was_checked(tmp_path: Path) -> None:
    verdict = check_units([tmp_path / BRIDGE_UNIT], which=lambda _name: None)
    assert verdict.good
    assert "systemd-analyze is not on this machine" in verdict.not_checked[0]


def checked(verify: tuple[int, str], security: tuple[int, str]) -> UnitVerdict:
    return check_units(
        [Path("/x") / BRIDGE_UNIT],
        run=lambda command: verify if command[1] == "verify" else security,
        which=lambda name: name,
    )


SCORED = (0, f"→ Overall exposure level for {BRIDGE_UNIT}: 1.3 OK\n")


@pytest.mark.parametrize(
    ("status", "line", "good", "others"),
    [
        (0, "/lib/systemd/system/plymouth.service:12: Unknown key", True, 1),
        (0, f"/x/{BRIDGE_UNIT}:3: Unknown key", False, 0),
        (0, "Failed to load something", False, 0),
        (1, "", False, 0),
    ],
    ids=["about another unit", "about this unit", "about none", "a failure without a line"],
)
def test_every_line_of_verify_is_a_complaint_unless_it_is_about_another_unit(
    status: int, line: str, good: bool, others: int
) -> None:
    verdict = checked((status, line), SCORED)
    assert (verdict.good, len(verdict.others)) == (good, others)


def test_an_old_systemd_that_cannot_score_files_is_reported() -> None:
    verdict = checked((0, ""), (1, "systemd-analyze: unrecognized option '--offline=true'\n"))
    assert verdict.good
    assert "systemd 250" in verdict.not_checked[0]


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="no systemd-sysusers here")
def test_systemd_makes_the_users_apart_from_each_other(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    file = tmp_path / "tic-vla-edge.conf"
    file.write_text(sysusers(ServiceUsers()))
    command = ["systemd-sysusers", f"--root={tmp_path}", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    users = dict(line.split(":")[0:3:2] for line in (tmp_path / "etc/passwd").read_text().splitlines())
    groups = {line.split(":")[0]: line.split(":")[3] for line in (tmp_path / "etc/group").read_text().splitlines()}
    assert users["tic-vla-bridge"] != users["tic-vla-runner"]
    assert groups["tic-vla-operators"] == groups["tic-vla-runner"] == ""


# --- the files that the services read, and those of the units


def test_files_that_the_services_user_cannot_read_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "artifacts"
    folder.mkdir(mode=0o755)
    for name, mode in (("graph.onnx", 0o600), ("manifest.json", 0o644)):
        (folder / name).touch()
        (folder / name).chmod(mode)
    assert unreadable([folder]) == [folder / "graph.onnx"]
    folder.chmod(0o700)
    assert unreadable([folder, folder]) == [folder, folder / "graph.onnx"]


def test_the_way_to_a_file_counts_where_the_services_see_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "closed").mkdir(mode=0o700)
    robot = tmp_path / "closed" / "robot.toml"
    robot.touch()
    robot.chmod(0o644)
    monkeypatch.setattr("edge.deploy.units.HIDDEN", (str(tmp_path),))
    assert unreadable([robot]) == []
    monkeypatch.setattr("edge.deploy.units.HIDDEN", ())
    assert tmp_path / "closed" in unreadable([robot])


def test_a_sticky_folder_lets_only_the_owner_replace_a_file(tmp_path: Path) -> None:
    robot = tmp_path / "robot.toml"
    robot.touch(0o644)
    tmp_path.chmod(0o1777)
    check_writers([robot])
    tmp_path.chmod(0o777)
    with pytest.raises(UnitError, match="found mode 0777"):
        check_writers([robot])


def test_a_full_disk_leaves_every_unit_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = tmp_path / "first.service", tmp_path / "second.service"
    first.write_text("old")

    def write(path: Path, text: str) -> None:
        if path.name.startswith("second"):
            raise OSError(errno.ENOSPC, "No space left on device")
        path.write_text(text)

    monkeypatch.setattr("edge.deploy.unit_files.write_whole", write)
    with pytest.raises(OutputError, match=r"second\.service: No space left on device; no file was changed"):
        write_units({first: "new", second: "new"}, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["first.service"] and first.read_text() == "old"
