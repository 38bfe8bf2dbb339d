"""The systemd units: quoted as systemd reads them, hardened as promised, the bridge outliving the runner."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
from ipaddress import IPv4Network
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.device import CUDA
from edge.deploy.unit_check import MAX_EXPOSURE, UnitVerdict, check_units, systemd_version
from edge.deploy.unit_text import ServiceUsers, UnitError, argument, bound, sysusers, word
from edge.deploy.units import (
    BRIDGE_UNIT,
    FIREWALL_UNIT,
    RUNNER_UNIT,
    SOCKET,
    ServiceInputs,
    bridge_unit,
    firewall_rules,
    firewall_unit,
    runner_unit,
)
from edge.inference.graph import CPU_PROVIDER

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
PRINTABLE = st.text(st.characters(exclude_categories=("C", "Z"), include_characters=" "), max_size=60)


def inputs(**changes: object) -> ServiceInputs:
    defaults = ServiceInputs(
        programs=Path("/opt/tic-vla/bin"),
        python=Path("/opt/tic-vla/bin/python"),
        prefixes=(Path("/opt/tic-vla"), Path("/usr")),
        robot=Path("/etc/tic-vla/go2.toml"),
        robot_files=(),
        artifacts=Path("/opt/tic-vla/orin"),
        engines=None,
        trust=None,
        instruction="walk to the vending machine",
        users=ServiceUsers(),
        interface="eth0",
        domain=0,
        networks=(IPv4Network("192.168.123.161/32"),),
        own=(IPv4Network("192.168.123.99/32"),),
        nft=Path("/usr/bin/true"),
        providers=(CPU_PROVIDER,),
        devices=(),
        groups=(),
        memory_bytes=12 << 30,
        control_priority=50,
        operator_arm=True,
        bridge_cores=(),
        systemd=252,
    )
    return dataclasses.replace(defaults, **changes)


def settings(text: str) -> dict[str, list[str]]:
    """Values of every key, in order."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line and line[0] not in "#[":
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def read_words(text: str, *, variables: bool) -> list[str]:
    """Words of a value by the rules of systemd.syntax(7): quotes, backslashes, then specifiers, then variables."""
    words: list[str] = []
    for quoted in re.findall(r'"((?:[^"\\]|\\.)*)"', text, re.DOTALL):
        plain = re.sub(r"\\(.)", lambda escape: {"n": "\n", "t": "\t"}.get(escape[1], escape[1]), quoted)
        assert not re.search(r"(?<!%)(?:%%)*%(?!%)", plain), "a lone % is a specifier"
        plain = plain.replace("%%", "%")
        if variables:
            assert not re.search(r"(?<!\$)(?:\$\$)*\$(?!\$)", plain), "a lone $ is a variable"
            plain = plain.replace("$$", "$")
        words.append(plain)
    return words


@given(PRINTABLE)
def test_systemd_reads_an_argument_as_it_was_meant(text: str) -> None:
    assert read_words(argument(text), variables=True) == [text]


@given(PRINTABLE)
def test_systemd_reads_a_word_as_it_was_meant(text: str) -> None:
    assert read_words(word(text), variables=False) == [text]


@pytest.mark.parametrize("text", ["two\nlines", "nul\0", "bell\a", "\u202e"])
def test_a_character_that_a_unit_cannot_carry_is_refused(text: str) -> None:
    with pytest.raises(UnitError, match="cannot carry"):
        argument(text)


def test_a_colon_cannot_be_in_a_path_that_is_shown_to_a_service() -> None:
    with pytest.raises(UnitError, match="colon"):
        bound("/home/a:b")


INSTRUCTIONS = [
    "walk 100% of the way, then stop; it's $5",
    'say "hello" to C:\\robots\\${HOME}',
    "--json /etc/passwd",
    "geh zum Süßigkeitenautomaten 🍫",
]


@pytest.mark.parametrize("text", INSTRUCTIONS)
def test_an_instruction_reaches_the_runner_unchanged(text: str) -> None:
    (command,) = settings(runner_unit(inputs(instruction=text)))["ExecStart"]
    words = read_words(command.replace("${INVOCATION_ID}", ""), variables=True)
    assert [word for word in words if word.startswith("--instruction")] == [f"--instruction={text}"]


def test_every_start_writes_a_flight_log_of_its_own() -> None:
    (command,) = settings(runner_unit(inputs()))["ExecStart"]
    assert '"--record" "/var/lib/tic-vla-edge/flight-${INVOCATION_ID}.mcap"' in command


def test_old_flight_logs_are_cleaned_up_before_every_start_which_does_not_hang_on_it() -> None:
    (command,) = settings(runner_unit(inputs()))["ExecStartPre"]
    assert command == '-"/opt/tic-vla/bin/python" "-I" "-m" "edge.flightlog.cleanup" "/var/lib/tic-vla-edge"'


def test_a_trusted_key_and_the_memory_of_releases_are_given_to_the_runner() -> None:
    (command,) = settings(runner_unit(inputs(trust=Path("/etc/tic-vla/key.pub"))))["ExecStart"]
    assert '"--trust" "/etc/tic-vla/key.pub" "--state" "/var/lib/tic-vla-edge"' in command
    assert "--trust" not in runner_unit(inputs())


def test_bridge_and_runner_are_different_users() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    assert (bridge["User"], runner["User"]) == (["tic-vla-bridge"], ["tic-vla-runner"])


def test_the_runner_gets_the_command_socket_and_is_not_in_the_operators_group() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    words = read_words(bridge["ExecStart"][0], variables=True)
    assert words[words.index("--runner-group") + 1] == runner["User"][0]
    assert words[words.index("--operator-group") + 1] == "tic-vla-operators"
    assert "tic-vla-operators" not in runner_unit(inputs())


def test_the_bridge_may_give_its_sockets_to_both_groups() -> None:
    found = settings(bridge_unit(inputs()))
    assert found["SupplementaryGroups"] == ["tic-vla-runner tic-vla-operators"]
    # The last filter adds to what the ones before it have left; @privileged holds both calls.
    assert found["SystemCallFilter"][-1] == "chown fchownat"
    assert "PrivateUsers" not in found, "in a user namespace other users' groups do not exist"


def test_the_runner_sees_the_number_of_the_bridges_user() -> None:
    assert "PrivateUsers" not in settings(runner_unit(inputs()))


def test_both_speak_over_a_socket_in_a_folder_that_only_the_bridge_may_write_to() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    assert f"/run/{bridge['RuntimeDirectory'][0]}" == str(SOCKET.parent)
    assert bridge["RuntimeDirectoryMode"] == ["0711"]
    assert all(f'"{SOCKET}"' in unit["ExecStart"][0] for unit in (bridge, runner))
    # The runner must not take the folder away when it ends.
    assert "RuntimeDirectory" not in runner


def test_the_bridge_outlives_the_runner() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    assert BRIDGE_UNIT in runner["After"]
    assert BRIDGE_UNIT in runner["Wants"]
    assert RUNNER_UNIT not in bridge_unit(inputs())
    assert int(bridge["OOMScoreAdjust"][0]) < 0 < int(runner["OOMScoreAdjust"][0])


def test_both_may_lock_their_memory_and_neither_may_take_all_of_it() -> None:
    for unit in (bridge_unit, runner_unit):
        found = settings(unit(inputs()))
        assert (found["LimitMEMLOCK"], found["MemorySwapMax"]) == (["infinity"], ["0"])
        assert "MemoryMax" in found


def test_where_only_a_graphics_cards_memory_is_known_the_runner_gets_a_share_of_the_machines() -> None:
    assert settings(runner_unit(inputs(memory_bytes=None)))["MemoryMax"] == ["75%"]


def test_the_bridge_comes_before_the_control_thread_on_a_core() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    assert bridge["CPUSchedulingPolicy"] == ["fifo"]
    assert int(bridge["CPUSchedulingPriority"][0]) > int(runner["LimitRTPRIO"][0]) > 0
    assert "CPUSchedulingPolicy" not in runner


def test_nothing_reports_to_anybody_outside() -> None:
    assert settings(runner_unit(inputs()))["Environment"] == ["ORT_DISABLE_TELEMETRY=1"]


def test_a_bridge_that_restarts_does_not_restart_the_runner() -> None:
    assert not {"Requires", "BindsTo", "PartOf"} & set(settings(runner_unit(inputs())))


def test_a_runner_that_decided_to_end_is_not_started_again() -> None:
    assert settings(runner_unit(inputs()))["Restart"] == ["on-abnormal"]
    assert settings(bridge_unit(inputs()))["Restart"] == ["always"]


def test_a_runner_that_arms_by_itself_is_not_started_again_after_a_crash_either() -> None:
    assert settings(runner_unit(inputs(operator_arm=False)))["Restart"] == ["no"]


@pytest.mark.parametrize("unit", [bridge_unit, runner_unit])
def test_a_stopped_process_cannot_hold_up_its_own_end(unit) -> None:
    found = settings(unit(inputs()))
    assert found["WatchdogSignal"] == ["SIGKILL"]
    assert int(found["WatchdogSec"][0]) <= 3
    assert {"TimeoutAbortSec", "TimeoutStopSec", "TimeoutStartSec"} <= set(found)


def test_a_runner_that_keeps_failing_is_given_up() -> None:
    assert settings(runner_unit(inputs()))["StartLimitBurst"] == ["5"]


@pytest.mark.parametrize("version", [None, 249, 252, 254, 257])
def test_a_bridge_that_keeps_failing_is_started_again_without_end(version: int | None) -> None:
    found = settings(bridge_unit(inputs(systemd=version)))
    assert (found["StartLimitIntervalSec"], found["Restart"]) == (["0"], ["always"])
    assert "StartLimitBurst" not in found


@pytest.mark.parametrize("version", [None, 249, 253])
def test_an_older_systemd_restarts_the_bridge_every_second(version: int | None) -> None:
    found = settings(bridge_unit(inputs(systemd=version)))
    assert found["RestartSec"] == ["1s"]
    assert not {"RestartSteps", "RestartMaxDelaySec"} & set(found)


def test_a_newer_systemd_restarts_the_bridge_at_once_and_then_backs_off() -> None:
    found = settings(bridge_unit(inputs(systemd=254)))
    assert (found["RestartSec"], found["RestartSteps"], found["RestartMaxDelaySec"]) == (["100ms"], ["5"], ["5s"])


def test_the_bridge_waits_for_no_network_so_that_it_can_latch_a_stop_before_the_cable_is_in() -> None:
    assert "network-online.target" not in bridge_unit(inputs())
    assert "network-online.target" in runner_unit(inputs())


def test_slow_failing_starts_of_the_runner_are_counted_within_one_window() -> None:
    found = {key: int(values[0]) for key, values in settings(runner_unit(inputs())).items() if values[0].isdigit()}
    assert found["StartLimitIntervalSec"] >= found["StartLimitBurst"] * found["TimeoutStartSec"]


def test_only_the_robots_network_is_let_through() -> None:
    for unit in (bridge_unit, runner_unit):
        found = settings(unit(inputs()))
        assert found["IPAddressDeny"] == ["any"]
        assert found["IPAddressAllow"] == ["192.168.123.161/32 192.168.123.99/32 239.255.0.1/32"]
        assert found["RestrictAddressFamilies"] == ["AF_UNIX AF_INET AF_NETLINK"]


def test_the_firewall_is_loaded_before_both_and_neither_depends_on_it() -> None:
    firewall = settings(firewall_unit(inputs()))
    assert firewall["Before"] == [f"{BRIDGE_UNIT} {RUNNER_UNIT}"]
    for unit in (bridge_unit, runner_unit):
        found = settings(unit(inputs()))
        assert FIREWALL_UNIT in found["Wants"]
        assert not {"Requires", "BindsTo"} & set(found)


def test_the_firewall_names_both_users_and_the_robots_cable() -> None:
    text = firewall_rules(inputs())
    assert 'meta skuid { "tic-vla-bridge", "tic-vla-runner", "root" } ip daddr @robot' in text
    assert 'oifname != "eth0" accept' in text


@pytest.mark.parametrize("changes", [{"interface": "lo"}, {"nft": None}])
def test_without_a_firewall_no_unit_waits_for_it(changes: dict[str, object]) -> None:
    assert FIREWALL_UNIT not in bridge_unit(inputs(**changes)) + runner_unit(inputs(**changes))


def test_a_simulated_robot_needs_no_network_to_be_up() -> None:
    assert "network-online.target" not in runner_unit(inputs(interface="lo"))


def test_what_lies_in_a_home_folder_is_shown_and_nothing_else() -> None:
    at_home = inputs(prefixes=(Path("/home/me/tic vla/.venv"),), artifacts=Path("/home/me/100%"))
    found = settings(runner_unit(at_home))
    assert found["ProtectHome"] == ["tmpfs"]
    assert read_words(found["BindReadOnlyPaths"][0], variables=False) == ["/home/me/100%", "/home/me/tic vla/.venv"]
    assert settings(runner_unit(inputs()))["ProtectHome"] == ["yes"]


def test_what_the_robot_file_names_is_shown_to_both() -> None:
    for unit in (bridge_unit, runner_unit):
        found = settings(unit(inputs(robot_files=(Path("/home/me/odometry.json"),))))
        assert read_words(found["BindReadOnlyPaths"][0], variables=False) == ["/home/me/odometry.json"]


def test_a_processor_needs_no_device_and_no_new_code() -> None:
    found = settings(runner_unit(inputs()))
    assert found["PrivateDevices"] == ["yes"]
    assert found["MemoryDenyWriteExecute"] == ["yes"]


def test_an_accelerator_gets_its_own_devices_and_no_others() -> None:
    nodes = (Path("/dev/nvhost-gpu"), Path("/dev/nvmap"))
    found = settings(runner_unit(inputs(providers=(CUDA,), devices=nodes, groups=("render", "video"))))
    assert found["DeviceAllow"] == ['"/dev/nvhost-gpu" rw', '"/dev/nvmap" rw']
    assert found["DevicePolicy"] == ["closed"]
    assert found["SupplementaryGroups"] == ["render video"]
    assert "PrivateDevices" not in found


def test_the_bridge_gets_the_cores_that_the_target_leaves_it() -> None:
    assert settings(bridge_unit(inputs(bridge_cores=(6, 7))))["CPUAffinity"] == ["6 7"]
    assert "CPUAffinity" not in settings(bridge_unit(inputs()))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"networks": ()}, "--network"),
        ({"robot": Path("go2.toml")}, "absolute"),
        ({"programs": Path("/opt/it's")}, "quote"),
        ({"memory_bytes": 0}, "memory"),
        ({"control_priority": 60}, "below the bridge's"),
        ({"networks": (IPv4Network("0.0.0.0/0"),)}, "expected a prefix of /16 or longer"),
        ({"networks": (IPv4Network("10.0.0.0/16"), IPv4Network("10.1.0.0/16"))}, "10.0.0.0/15 has 131072 addresses"),
    ],
)
def test_inputs_that_make_no_service_are_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(UnitError, match=says):
        inputs(**changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"bridge": "root"}, "--bridge-user root: expected"),
        ({"runner": "a b"}, "--runner-user a b: expected"),
        ({"operators": ""}, "--operator-group : expected"),
        ({"runner": "tic-vla-bridge"}, "expected three names"),
        ({"operators": "tic-vla-runner"}, "expected three names"),
    ],
)
def test_users_that_would_not_be_apart_are_refused(changes: dict[str, str], says: str) -> None:
    with pytest.raises(UnitError, match=re.escape(says)):
        ServiceUsers(**changes)


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
def test_systemd_finds_the_programs_whatever_their_folder_is_called(tmp_path: Path, folder: str) -> None:
    found = programs(tmp_path / folder)
    verdict = check_units(written(tmp_path, inputs(programs=found, python=found / "edge-run")))
    assert verdict.complaints == ()


@needs_systemd
def test_systemd_complains_about_a_program_that_is_missing(tmp_path: Path) -> None:
    complaints = check_units(written(tmp_path, inputs(programs=tmp_path / "nowhere"))).complaints
    assert any("edge-bridge" in line for line in complaints)


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


@needs_systemd
def test_a_service_that_gives_nothing_up_is_too_exposed(tmp_path: Path) -> None:
    path = tmp_path / BRIDGE_UNIT
    path.write_text(f"[Service]\nExecStart={programs(tmp_path / 'bin') / 'edge-bridge'}\n")
    verdict = check_units([path])
    assert verdict.exposure[BRIDGE_UNIT] > MAX_EXPOSURE
    assert not verdict.good


@needs_systemd
def test_this_machines_systemd_knows_every_key_of_the_bridges_back_off(tmp_path: Path) -> None:
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


def test_without_systemd_there_is_no_version() -> None:
    assert systemd_version(which=lambda _name: None) is None


def test_without_systemd_the_verdict_says_that_nothing_was_checked(tmp_path: Path) -> None:
    verdict = check_units([tmp_path / BRIDGE_UNIT], which=lambda _name: None)
    assert verdict.good
    assert "systemd-analyze is not on this machine" in verdict.not_checked[0]


def answers(verify: tuple[int, str], security: tuple[int, str]):
    return lambda command: verify if command[1] == "verify" else security


def checked(verify: tuple[int, str], security: tuple[int, str]) -> UnitVerdict:
    return check_units([Path("/x") / BRIDGE_UNIT], run=answers(verify, security), which=lambda name: name)


SCORED = (0, f"→ Overall exposure level for {BRIDGE_UNIT}: 1.3 OK\n")


def test_lines_about_other_units_of_the_machine_are_told_apart() -> None:
    verdict = checked((0, "/lib/systemd/system/plymouth.service:12: Unknown key\n"), SCORED)
    assert verdict.good
    assert len(verdict.others) == 1


@pytest.mark.parametrize("line", [f"/x/{BRIDGE_UNIT}:3: Unknown key", "Failed to load something"])
def test_any_other_line_of_verify_is_a_complaint(line: str) -> None:
    assert not checked((0, line), SCORED).good


def test_a_verify_that_fails_without_a_word_is_a_complaint() -> None:
    assert not checked((1, ""), SCORED).good


def test_an_old_systemd_that_cannot_score_files_is_said_to_be_one() -> None:
    verdict = checked((0, ""), (1, "systemd-analyze: unrecognized option '--offline=true'\n"))
    assert verdict.good
    assert "systemd 250" in verdict.not_checked[0]


def test_the_users_are_system_users_without_a_shell_and_the_group_is_the_peoples() -> None:
    text = sysusers(ServiceUsers("robot-bridge", "robot-runner", "robot-people"))
    for line in (r'^u robot-bridge - ".*" - -$', r'^u robot-runner - ".*" - -$', r"^g robot-people -$"):
        assert re.search(line, text, re.MULTILINE)


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="no systemd-sysusers here")
def test_systemd_makes_the_users_apart_from_each_other(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    file = tmp_path / "tic-vla-edge.conf"
    file.write_text(sysusers(ServiceUsers()))
    command = ["systemd-sysusers", f"--root={tmp_path}", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 0, done.stderr
    users = dict(line.split(":")[0:3:2] for line in (tmp_path / "etc/passwd").read_text().splitlines())
    groups = {line.split(":")[0]: line.split(":")[3] for line in (tmp_path / "etc/group").read_text().splitlines()}
    assert users["tic-vla-bridge"] != users["tic-vla-runner"]
    assert groups["tic-vla-operators"] == groups["tic-vla-runner"] == ""
