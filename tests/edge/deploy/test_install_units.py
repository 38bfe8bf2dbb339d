"""`edge-install units`: what it gathers, what it writes, what it refuses to overwrite; it starts nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import seal
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED
from edge.deploy.install import main
from edge.deploy.install_units import Host, robot_networks
from edge.deploy.unit_check import UnitVerdict
from edge.deploy.unit_text import SYSUSERS_FILE, UnitError
from edge.deploy.units import BRIDGE_UNIT, FIREWALL_FILE, FIREWALL_UNIT, RUNNER_UNIT, SOCKET
from edge.signature import keygen
from export.targets.file import load_target
from firmware_bridge.core.config import DdsConfig
from tests.support.processes import REPOSITORY

SHIPPED = REPOSITORY / "firmware_bridge" / "robots" / "go2.toml"
ADDRESSES = {"lo": [("127.0.0.1", "255.0.0.0")], "eth0": [("192.168.123.99", "255.255.255.0")]}
GOOD = UnitVerdict((), (), {BRIDGE_UNIT: 1.3, RUNNER_UNIT: 1.4}, ())


@pytest.fixture
def host(tmp_path: Path) -> Host:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("edge-bridge", "edge-run"):
        (programs / name).write_text("#!/bin/sh\n")
        (programs / name).chmod(0o755)
    return Host(
        root=tmp_path / "root",
        addresses=lambda: ADDRESSES,
        nft=lambda: Path("/usr/sbin/nft"),
        systemd=lambda: 252,
        check=lambda _paths: GOOD,
        programs=programs,
        python=programs / "python",
        prefixes=(Path("/usr"),),
    )


Units = Callable[..., tuple[int, dict[str, Any] | None]]


@pytest.fixture
def units(artifacts_dir: Path, tmp_path: Path, host: Host) -> Units:
    """Runs the command; its exit code and its result."""

    robot = tmp_path / "go2.toml"
    robot.write_text(SHIPPED.read_text())

    def run(
        *more: str, on: Host = host, artifacts: Path = artifacts_dir, text: str = "walk", robot: Path = robot
    ) -> Any:
        result = tmp_path / "result.json"
        result.unlink(missing_ok=True)
        place = [] if "--system" in more else ["--out", str(tmp_path / "units")]
        words = ["--artifacts", str(artifacts), "--robot", str(robot), "--json", str(result), *place, *more]
        if "--instruction-file" not in more:
            words += ["--instruction", text]
        code = main(["units", *words], host=on)
        return code, json.loads(result.read_text()) if result.exists() else None

    return run


@pytest.fixture
def alone(tmp_path: Path) -> Path:
    """File of a robot whose runner arms by itself."""
    robot = tmp_path / "alone.toml"
    robot.write_text(SHIPPED.read_text().replace("operator_arm = true", "operator_arm = false"))
    return robot


def test_it_writes_both_units_and_the_user_and_prints_the_start_command(units: Units, tmp_path: Path) -> None:
    code, result = units()
    assert code == EXIT_DONE
    expected = {BRIDGE_UNIT, RUNNER_UNIT, FIREWALL_UNIT, FIREWALL_FILE, SYSUSERS_FILE}
    assert {path.name for path in (tmp_path / "units").iterdir()} == expected
    assert result is not None
    assert result["exposure"] == GOOD.exposure
    services = (FIREWALL_UNIT, BRIDGE_UNIT, RUNNER_UNIT)
    assert result["commands"][-7:-1] == [
        *(f"sudo systemctl enable {unit}" for unit in services),
        *(f"sudo systemctl restart {unit}" for unit in services),  # one that runs keeps its old unit otherwise
    ]
    arm = f"sudo {tmp_path}/bin/edge-bridge arm --robot {tmp_path}/go2.toml --socket {SOCKET}"
    assert result["commands"][-1] == arm
    starts = [index for index, command in enumerate(result["commands"]) if "enable" in command]
    assert result["commands"].index("sudo systemd-sysusers") < starts[0]
    assert 'sudo usermod -aG tic-vla-operators "$USER"' in result["commands"]
    assert FIREWALL_UNIT in result["commands"][starts[0]]
    text = (tmp_path / "units" / RUNNER_UNIT).read_text()
    assert "drives after `edge-bridge arm` only" in text and "--arm-at-start" not in text
    assert '"--require-operator"' in text  # a robot file that is changed later must not make it drive by itself


@pytest.mark.slow
def test_services_of_a_board_follow_its_current_release(units: Units, artifacts_dir: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    release = home / "releases/3"
    (release / "venv").mkdir(parents=True)
    shutil.copytree(tmp_path / "bin", release / "venv/bin")
    shutil.copytree(artifacts_dir, release / "artifacts")
    (home / "current").symlink_to("releases/3")
    assert units(artifacts=home / "current/artifacts")[0] == EXIT_BAD_INPUT  # they would stay on this release
    assert units("--home", str(home), artifacts=home / "current/artifacts")[0] == EXIT_DONE
    for unit in (BRIDGE_UNIT, RUNNER_UNIT):
        text = (tmp_path / "units" / unit).read_text()
        assert f"{home}/current/venv/bin/edge-" in text and "releases/3" not in text
    assert f"{home}/current/artifacts" in text


def test_the_emergency_stop_of_this_service_is_printed(
    units: Units, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, result = units()
    stop = f"sudo {tmp_path}/bin/edge-bridge stop --robot {tmp_path}/go2.toml --socket {SOCKET}"
    assert result and result["stop"] == stop
    assert stop in capsys.readouterr().err
    assert stop not in result["commands"]  # which are given one after the other


def test_a_robot_that_would_drive_as_soon_as_its_service_starts_is_refused_in_one_line(
    units: Units, alone: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert units(robot=alone) == (EXIT_BAD_INPUT, None)
    error = capsys.readouterr().err
    assert "safety.operator_arm: expected true, found false" in error and error.count("\n") == 1
    assert not (tmp_path / "units").exists()


def test_with_consent_it_is_written_and_not_enabled_at_boot(units: Units, alone: Path, tmp_path: Path) -> None:
    code, result = units("--arm-at-start", robot=alone)
    assert (code, result and result["commands"][-1]) == (EXIT_DONE, f"sudo systemctl restart {RUNNER_UNIT}")
    assert result is not None
    assert not any("enable" in command and RUNNER_UNIT in command for command in result["commands"])
    text = (tmp_path / "units" / RUNNER_UNIT).read_text()
    assert "# --arm-at-start was given: " in text and "--require-operator" not in text


def test_a_robot_file_or_a_home_that_every_user_may_change_is_refused(
    units: Units, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path, mode in ((tmp_path / "go2.toml", 0o666), (tmp_path / "bin", 0o777)):
        before = path.stat().st_mode & 0o777
        path.chmod(mode)
        assert units() == (EXIT_BAD_INPUT, None)
        assert f"chmod o-w {path}" in capsys.readouterr().err and not (tmp_path / "units").exists()
        path.chmod(before)


def test_useless_consent_is_reported(units: Units, capsys: pytest.CaptureFixture[str]) -> None:
    assert units("--arm-at-start")[0] == EXIT_DONE
    assert "--arm-at-start changes nothing" in capsys.readouterr().err


@pytest.mark.slow
def test_names_of_users_and_group_can_be_given(units: Units, tmp_path: Path) -> None:
    names = ("--bridge-user", "b", "--runner-user", "r", "--operator-group", "o")
    assert units(*names)[0] == EXIT_DONE
    text = (tmp_path / "units" / BRIDGE_UNIT).read_text()
    assert "\nUser=b\n" in text and '"--runner-group" "r" "--operator-group" "o"' in text
    assert units("--bridge-user", "r", "--runner-user", "r")[0] == EXIT_BAD_INPUT


def test_without_nft_the_rules_are_written_and_the_missing_package_is_named(
    units: Units, host: Host, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert units(on=replace(host, nft=lambda: None))[0] == EXIT_DONE
    written = {path.name for path in (tmp_path / "units").iterdir()}
    assert FIREWALL_FILE in written and FIREWALL_UNIT not in written
    assert "apt install nftables" in capsys.readouterr().err


@pytest.mark.slow
def test_a_firewall_that_accepts_a_whole_network_is_reported(
    units: Units, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units()
    assert "give the robot's own address with --network" in capsys.readouterr().err
    units("--network", "192.168.123.161/32", "--force")
    assert "give the robot's own address" not in capsys.readouterr().err
    assert "elements = { 192.168.123.161 }" in (tmp_path / "units" / FIREWALL_FILE).read_text()
    # The bridge still notices requests that other programs of this machine publish.
    assert "IPAddressAllow=192.168.123.161/32 192.168.123.99/32" in (tmp_path / "units" / BRIDGE_UNIT).read_text()


def test_a_simulated_robot_gets_no_firewall(units: Units, tmp_path: Path) -> None:
    robot = tmp_path / "sim.toml"
    simulated = SHIPPED.with_name("go2_sim.toml").read_text()
    robot.write_text(simulated.replace("operator_arm = false", "operator_arm = true"))
    assert units(robot=robot)[0] == EXIT_DONE
    assert not {FIREWALL_FILE, FIREWALL_UNIT} & {path.name for path in (tmp_path / "units").iterdir()}


def test_for_the_system_they_go_where_systemd_reads_them(units: Units, host: Host) -> None:
    code, _ = units("--system")
    assert code == EXIT_DONE
    assert (host.root / "etc/systemd/system" / RUNNER_UNIT).stat().st_mode & 0o777 == 0o644
    assert (host.root / "etc/sysusers.d" / SYSUSERS_FILE).is_file()
    assert (host.root / "etc/tic-vla-edge" / FIREWALL_FILE).is_file()


@pytest.mark.slow
def test_the_runners_memory_is_the_targets_budget(units: Units, tmp_path: Path) -> None:
    units()
    device = load_target("cpu", "nano").device
    available = round((device.memory_gib - device.reserved_gib) * (1 << 30))
    assert f"\nMemoryMax={available}\n" in (tmp_path / "units" / RUNNER_UNIT).read_text()


def test_the_instruction_can_come_from_a_file(units: Units, tmp_path: Path) -> None:
    (tmp_path / "instruction.txt").write_text("walk to\nthe door\n")
    units("--instruction-file", str(tmp_path / "instruction.txt"))
    assert '"--instruction=walk to the door"' in (tmp_path / "units" / RUNNER_UNIT).read_text()


@pytest.mark.slow
def test_a_second_run_writes_nothing(units: Units) -> None:
    units()
    code, result = units()
    assert (code, result and result["written"]) == (EXIT_DONE, [])


@pytest.mark.slow
def test_a_file_that_differs_is_replaced_only_by_force(
    units: Units, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units()
    before = (tmp_path / "units" / RUNNER_UNIT).read_text()
    (tmp_path / "units" / BRIDGE_UNIT).unlink()
    code, _ = units(text="turn left")
    assert code == EXIT_BAD_INPUT
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "units" / RUNNER_UNIT).read_text() == before
    assert not (tmp_path / "units" / BRIDGE_UNIT).exists(), "nothing is written when one file is in the way"
    assert units("--force", text="turn left")[0] == EXIT_DONE
    assert (tmp_path / "units" / RUNNER_UNIT).read_text() != before
    (tmp_path / "units" / BRIDGE_UNIT).unlink()
    (tmp_path / "units" / BRIDGE_UNIT).symlink_to(tmp_path / "elsewhere")
    assert units("--force")[0] == EXIT_BAD_INPUT
    assert not (tmp_path / "elsewhere").exists(), "a link is never written through"


@pytest.mark.parametrize(
    "verdict",
    [replace(GOOD, complaints=("unknown key",)), replace(GOOD, exposure={BRIDGE_UNIT: 3.1})],
    ids=["complaint", "exposed"],
)
def test_a_complaint_of_systemd_is_a_failed_check(units: Units, host: Host, verdict: UnitVerdict) -> None:
    code, result = units(on=replace(host, check=lambda _paths: verdict))
    assert code == EXIT_CHECK_FAILED
    assert result is not None


def test_artifacts_of_another_target_are_refused(units: Units, capsys: pytest.CaptureFixture[str]) -> None:
    assert units("--target", "orin")[0] == EXIT_REFUSED
    assert "expected orin" in capsys.readouterr().err


@pytest.mark.slow
def test_artifacts_that_the_trusted_key_has_not_signed_are_refused(units: Units, tmp_path: Path) -> None:
    keygen(tmp_path / "release.pem")
    assert units("--trust", str(tmp_path / "release.pem.pub"))[0] == EXIT_REFUSED
    assert units("--trust", str(tmp_path / "none.pub"))[0] == EXIT_BAD_INPUT


@pytest.mark.parametrize("text", ["", "x" * 401, "a \u202e b"])
def test_an_instruction_that_cannot_be_given_is_bad_input(units: Units, text: str) -> None:
    assert units(text=text)[0] == EXIT_BAD_INPUT


def test_a_program_that_is_not_installed_is_named(
    units: Units, host: Host, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert units(on=replace(host, programs=tmp_path))[0] == EXIT_BAD_INPUT
    assert "edge-bridge: missing" in capsys.readouterr().err


@pytest.fixture
def orin_dir(artifacts_dir: Path, tmp_path: Path) -> Path:
    """The same graphs under a manifest of the Jetson target."""
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "orin"))
    manifest = json.loads((copy / "manifest.json").read_text())
    target = load_target("orin", "nano")
    manifest["target"] = target.name
    manifest["provenance"]["target"] = target.to_dict()
    for name, entry in manifest["graphs"].items():
        entry["session"] = target.session(name, entry["inputs"])
    (copy / "manifest.json").write_text(json.dumps(seal(manifest)))
    return copy


def jetson(host: Host) -> Host:
    names = ("nvmap", "nvhost-ctrl", "nvgpu/igpu0/as", "sda", "host1x-fence", "dri/renderD128", "dri/card0")
    make_nodes(host.root, names)
    for name in names:
        (host.root / "dev" / name).chmod(0o666)
    return host


@pytest.mark.slow
def test_the_jetsons_runner_gets_its_nodes_and_its_engines(
    units: Units, host: Host, orin_dir: Path, tmp_path: Path
) -> None:
    code, _ = units("--target", "orin", on=jetson(host), artifacts=orin_dir)
    text = (tmp_path / "units" / RUNNER_UNIT).read_text()
    assert code == EXIT_DONE
    assert [line for line in text.splitlines() if line.startswith("DeviceAllow")] == [
        'DeviceAllow="/dev/dri/renderD128" rw',
        'DeviceAllow="/dev/host1x-fence" rw',
        'DeviceAllow="/dev/nvgpu/igpu0/as" rw',
        'DeviceAllow="/dev/nvhost-ctrl" rw',
        'DeviceAllow="/dev/nvmap" rw',
    ]
    assert f'"--engines" "{tmp_path}/orin.engines"' in text


@pytest.mark.slow
def test_a_runner_without_its_device_is_written_but_not_installed(
    units: Units, orin_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert units(artifacts=orin_dir)[0] == EXIT_DONE
    assert "run this on the device" in capsys.readouterr().err
    assert units("--system", artifacts=orin_dir)[0] == EXIT_REFUSED


def make_nodes(root: Path, names: Sequence[str]) -> None:
    for name in names:
        (root / "dev" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "dev" / name).touch()


def networks(dds: DdsConfig, *given: str) -> list[str]:
    return [str(network) for network in robot_networks(dds, given, lambda: ADDRESSES)]


@pytest.mark.parametrize(
    ("dds", "given", "expected"),
    [
        (DdsConfig(0, "eth0"), (), ["192.168.123.0/24"]),
        (DdsConfig(0, "lo", ("127.0.0.1",)), (), ["127.0.0.0/8"]),
        (DdsConfig(0, "eth0", ("10.0.0.7",)), (), ["10.0.0.7/32", "192.168.123.0/24"]),
        (DdsConfig(0, "wlan0", ("robot.local",)), ("10.1.0.0/30",), ["10.1.0.0/30"]),
        (DdsConfig(0, "eth0"), ("127.0.0.0/8",), ["127.0.0.0/8"]),
    ],
    ids=[
        "its interface's",
        "loopback",
        "and a peer outside of it",
        "the given one instead",
        "a wide one within the host",
    ],
)
def test_the_robots_network_is(dds: DdsConfig, given: tuple[str, ...], expected: list[str]) -> None:
    assert networks(dds, *given) == expected


@pytest.mark.parametrize("network", ["0.0.0.0/0", "0.0.0.0/1", "192.0.0.0/8", "10.0.0.0/15", "::/0", "fe80::/64"])
def test_a_network_that_would_let_everything_through_is_refused_in_one_line(
    units: Units, tmp_path: Path, capsys: pytest.CaptureFixture[str], network: str
) -> None:
    assert units("--network", "192.168.123.0/24", "--network", network) == (EXIT_BAD_INPUT, None)
    error = capsys.readouterr().err
    assert f"--network {network}: " in error and "expected" in error and error.count("\n") == 1
    assert not (tmp_path / "units").exists()


def test_artifacts_whose_runner_would_run_before_the_bridge_are_refused(
    units: Units, artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "artifacts"))
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["runtime"]["control_priority"] = 60
    (copy / "manifest.json").write_text(json.dumps(seal(manifest)))
    assert units(artifacts=copy) == (EXIT_REFUSED, None)
    assert "control_priority 60, expected 0 to 59, below the bridge's 60" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("dds", "given"),
    [
        (DdsConfig(0, "wlan0"), ()),
        (DdsConfig(0, "eth0", ("robot.local",)), ()),
        (DdsConfig(0, "eth0"), ("10.0.0.1/8",)),
    ],
)
def test_an_unknown_network_is_refused_with_the_option_that_sets_it(dds: DdsConfig, given: tuple[str, ...]) -> None:
    with pytest.raises(UnitError, match="--network"):
        networks(dds, *given)
    with pytest.raises(UnitError, match=r"eth0.*10\.0\.0\.0/8.*--network"):
        robot_networks(DdsConfig(0, "eth0"), (), lambda: {"eth0": [("10.1.2.3", "255.0.0.0")]})
