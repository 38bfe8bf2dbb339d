"""The systemd units: quoted as systemd reads them, hardened as promised, the bridge outliving the runner."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from ipaddress import IPv4Network
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.device import CUDA
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
def test_systemd_reads_an_argument_and_a_word_as_they_were_meant(text: str) -> None:
    assert read_words(argument(text), variables=True) == [text]
    assert read_words(word(text), variables=False) == [text]


@pytest.mark.parametrize("text", ["two\nlines", "nul\0", "bell\a", "\u202e"])
def test_a_character_that_a_unit_cannot_carry_is_refused(text: str) -> None:
    with pytest.raises(UnitError, match="cannot carry"):
        argument(text)
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


AT_HOME = (Path("/home/me/odometry.json"),)


@pytest.mark.parametrize(
    ("unit", "changes", "expected"),
    [
        (bridge_unit, {}, {"Restart": ["always"], "CPUSchedulingPolicy": ["fifo"], "User": ["tic-vla-bridge"]}),
        (runner_unit, {}, {"Restart": ["on-abnormal"], "User": ["tic-vla-runner"], "StartLimitBurst": ["5"]}),
        (runner_unit, {"operator_arm": False}, {"Restart": ["no"]}),
        (runner_unit, {}, {"Environment": ["ORT_DISABLE_TELEMETRY=1"]}),
        (runner_unit, {}, {"PrivateDevices": ["yes"], "MemoryDenyWriteExecute": ["yes"]}),
        (runner_unit, {"memory_bytes": None}, {"MemoryMax": ["75%"]}),
        (bridge_unit, {"bridge_cores": (6, 7)}, {"CPUAffinity": ["6 7"]}),
        (bridge_unit, {"systemd": 254}, {"RestartSec": ["100ms"], "RestartSteps": ["5"], "RestartMaxDelaySec": ["5s"]}),
        (bridge_unit, {"robot_files": AT_HOME}, {"BindReadOnlyPaths": ['"/home/me/odometry.json"']}),
        (runner_unit, {"robot_files": AT_HOME}, {"BindReadOnlyPaths": ['"/home/me/odometry.json"']}),
        (
            runner_unit,
            {},
            {"ExecStartPre": ['-"/opt/tic-vla/bin/python" "-I" "-m" "edge.flightlog.cleanup" "/var/lib/tic-vla-edge"']},
        ),
    ],
)
def test_a_unit_has_these_settings(
    unit: Callable[[ServiceInputs], str], changes: dict[str, object], expected: dict[str, list[str]]
) -> None:
    assert expected.items() <= settings(unit(inputs(**changes))).items()


@pytest.mark.parametrize(
    ("unit", "changes", "absent"),
    [
        # A bridge that restarts must not restart the runner, whose robot would drive on.
        (runner_unit, {}, "Requires="),
        (runner_unit, {}, "BindsTo="),
        (runner_unit, {}, "PartOf="),
        # In a user namespace the bridge's user has no number: the runner could not tell it from an impostor.
        (runner_unit, {}, "PrivateUsers="),
        # The bridge latches a stop before the robot's cable is in.
        (bridge_unit, {}, "network-online.target"),
        (runner_unit, {"interface": "lo"}, "network-online.target"),
        (runner_unit, {}, "--trust"),
        (bridge_unit, {}, "CPUAffinity="),
        (bridge_unit, {}, RUNNER_UNIT),
        (runner_unit, {}, "tic-vla-operators"),
    ],
)
def test_a_unit_lacks_these_settings(
    unit: Callable[[ServiceInputs], str], changes: dict[str, object], absent: str
) -> None:
    assert absent not in unit(inputs(**changes))


@pytest.mark.parametrize(
    ("changes", "arguments"),
    [
        ({}, '"--record" "/var/lib/tic-vla-edge/flight-${INVOCATION_ID}.mcap"'),
        ({"trust": Path("/k.pub")}, '"--trust" "/k.pub" "--state" "/var/lib/tic-vla-edge"'),
    ],
    ids=["a flight log of its own for every start", "the trusted key and the newest release"],
)
def test_the_runner_is_started_with(changes: dict[str, object], arguments: str) -> None:
    assert arguments in settings(runner_unit(inputs(**changes)))["ExecStart"][0]


def test_the_runner_gets_the_command_socket_and_is_not_in_the_operators_group() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    words = read_words(bridge["ExecStart"][0], variables=True)
    assert words[words.index("--runner-group") + 1] == runner["User"][0]
    assert words[words.index("--operator-group") + 1] == "tic-vla-operators"


def test_the_bridge_may_give_its_sockets_to_both_groups() -> None:
    found = settings(bridge_unit(inputs()))
    assert found["SupplementaryGroups"] == ["tic-vla-runner tic-vla-operators"]
    # The last filter adds to what the ones before it have left; @privileged holds both calls.
    assert found["SystemCallFilter"][-2:] == ["chown fchownat", "sched_setscheduler"]
    assert "PrivateUsers" not in found, "in a user namespace other users' groups do not exist"


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
    assert "network-online.target" in runner["Wants"]
    assert int(bridge["OOMScoreAdjust"][0]) < 0 < int(runner["OOMScoreAdjust"][0])


def test_both_may_lock_their_memory_and_neither_may_take_all_of_it() -> None:
    for unit in (bridge_unit, runner_unit):
        found = settings(unit(inputs()))
        assert (found["LimitMEMLOCK"], found["MemorySwapMax"]) == (["infinity"], ["0"])
        assert "MemoryMax" in found


def test_the_bridge_comes_before_the_control_thread_on_a_core() -> None:
    bridge, runner = settings(bridge_unit(inputs())), settings(runner_unit(inputs()))
    assert int(bridge["CPUSchedulingPriority"][0]) > int(runner["LimitRTPRIO"][0]) > 0
    assert "CPUSchedulingPolicy" not in runner


@pytest.mark.parametrize("unit", [bridge_unit, runner_unit])
def test_a_stopped_process_cannot_hold_up_its_own_end(unit) -> None:
    found = settings(unit(inputs()))
    assert found["WatchdogSignal"] == ["SIGKILL"]
    assert int(found["WatchdogSec"][0]) <= 3
    assert {"TimeoutAbortSec", "TimeoutStopSec", "TimeoutStartSec"} <= set(found)


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


def test_only_the_needed_files_of_a_home_folder_are_visible() -> None:
    at_home = inputs(prefixes=(Path("/home/me/tic vla/.venv"),), artifacts=Path("/home/me/100%"))
    found = settings(runner_unit(at_home))
    assert found["ProtectHome"] == ["tmpfs"]
    assert read_words(found["BindReadOnlyPaths"][0], variables=False) == ["/home/me/100%", "/home/me/tic vla/.venv"]
    assert settings(runner_unit(inputs()))["ProtectHome"] == ["yes"]


def test_an_accelerator_gets_its_own_devices_and_no_others() -> None:
    nodes = (Path("/dev/nvhost-gpu"), Path("/dev/nvmap"))
    found = settings(runner_unit(inputs(providers=(CUDA,), devices=nodes, groups=("render", "video"))))
    assert found["DeviceAllow"] == ['"/dev/nvhost-gpu" rw', '"/dev/nvmap" rw']
    assert found["DevicePolicy"] == ["closed"]
    assert found["SupplementaryGroups"] == ["render video"]
    assert "PrivateDevices" not in found


@pytest.mark.parametrize(
    ("changes", "message"),
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
def test_inputs_that_make_no_service_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UnitError, match=message):
        inputs(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bridge": "root"}, "--bridge-user root: expected"),
        ({"runner": "a b"}, "--runner-user a b: expected"),
        ({"operators": ""}, "--operator-group : expected"),
        ({"runner": "tic-vla-bridge"}, "expected three names"),
        ({"operators": "tic-vla-runner"}, "expected three names"),
    ],
)
def test_users_that_would_not_be_apart_are_refused(changes: dict[str, str], message: str) -> None:
    with pytest.raises(UnitError, match=re.escape(message)):
        ServiceUsers(**changes)


def test_the_users_are_system_users_without_a_shell_and_the_group_is_the_peoples() -> None:
    text = sysusers(ServiceUsers("robot-bridge", "robot-runner", "robot-people"))
    for line in (r'^u robot-bridge - ".*" - -$', r'^u robot-runner - ".*" - -$', r"^g robot-people -$"):
        assert re.search(line, text, re.MULTILINE)
