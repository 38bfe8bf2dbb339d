"""`edge-doctor` on machines made of files: what it finds, what it expects, what to do; and on the robot's cable."""

from __future__ import annotations

import argparse
import datetime
import io
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from edge.artifacts.target_facts import GIB, PlanFacts, TargetFacts
from edge.core.device import CUDA
from edge.deploy import boot
from edge.deploy.doctor.check import Check, Level, failed, skipped, table
from edge.deploy.doctor.link import cable
from edge.deploy.doctor.machine import (
    boot_power_mode,
    busy_programs,
    clocks,
    core_numbers,
    cpu_governor,
    disk,
    hardware_watchdog,
    match,
    memory,
    power_mode,
    processor_ticks,
    wall_clock,
)
from edge.inference.graph import CPU_PROVIDER

ORIN = TargetFacts("orin", ("aarch64",), 8, 16 * GIB, 12 * GIB, "36.4", "40W", 25.0)
PLAN = PlanFacts(100.0, 60.0, 40.0, 0.2, 1100, 4 * GIB, "modelled")
CONF = """
< POWER_MODEL ID=1 NAME=10W >
CPU_ONLINE CORE_0 1
CPU_ONLINE CORE_1 1
CPU_ONLINE CORE_4 0
GPU MAX_FREQ 612000000
< POWER_MODEL ID=4 NAME=40W >
CPU_ONLINE CORE_0 1
CPU_ONLINE CORE_1 1
CPU_ONLINE CORE_4 1
"""


def write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("wanted", "answer", "level", "text"),
    [
        ("40W", "NV Power Mode: 40W\n4\n", Level.OK, ""),
        ("40W", "NV Power Mode: 10W\n1\n", Level.FAIL, "sudo nvpmodel -m 4"),
        ("25W", "NV Power Mode: 10W\n1\n", Level.FAIL, "10W, 40W"),
        ("10W", "NV Power Mode: 10W\n1\n", Level.FAIL, "reboot"),
        ("40W", None, Level.FAIL, ""),
    ],
    ids=["as wanted", "another", "unknown to the board", "reported, but its cores are not online", "no answer"],
)
def test_the_power_mode_is_known_by_its_name_and_its_cores(
    tmp_path: Path, wanted: str, answer: str | None, level: Level, text: str
) -> None:
    write(tmp_path, {"etc/nvpmodel.conf": CONF, "sys/devices/system/cpu/online": "0-1,4\n"})
    check = power_mode(wanted, tmp_path, lambda: answer)
    assert check.level is level and text in check.found + check.advice


def test_without_its_configuration_this_is_no_jetson(tmp_path: Path) -> None:
    assert power_mode("default", tmp_path, lambda: None).level is Level.SKIP


@pytest.mark.parametrize(
    ("text", "cores"), [("0-3,6", {0, 1, 2, 3, 6}), ("5", {5}), ("", set()), ("a-b", set()), ("1-99999", set())]
)
def test_a_list_of_cores_is_read(text: str, cores: set[int]) -> None:
    assert core_numbers(text) == cores


@pytest.mark.parametrize(
    ("governors", "level"), [(["performance"], Level.OK), (["performance", "schedutil"], Level.WARN), ([], Level.SKIP)]
)
def test_a_governor_that_follows_the_load_is_a_warning(tmp_path: Path, governors: list[str], level: Level) -> None:
    cpu = "sys/devices/system/cpu"
    write(tmp_path, {f"{cpu}/cpu{n}/cpufreq/scaling_governor": f"{name}\n" for n, name in enumerate(governors)})
    assert cpu_governor(tmp_path).level is level


def devfreq(root: Path, low: int, high: int) -> Path:
    gpu = "sys/class/devfreq/17000000.gpu"
    steps = "306000000 408000000 1173000000"
    files = {"min_freq": str(low), "max_freq": str(high), "cur_freq": str(low), "available_frequencies": steps}
    return write(root, {f"{gpu}/{name}": f"{text}\n" for name, text in files.items()})


def test_a_graphics_clock_that_may_fall_is_a_warning_and_one_that_stays_is_fine(tmp_path: Path) -> None:
    check = clocks(devfreq(tmp_path, 306_000_000, 408_000_000))
    assert check.level is Level.WARN
    assert "jetson_clocks" in check.advice and "of 1173" in check.found
    assert clocks(devfreq(tmp_path, 408_000_000, 408_000_000)).level is Level.OK


def test_a_clock_of_something_else_is_not_taken_for_the_graphics_processor(tmp_path: Path) -> None:
    write(tmp_path, {f"sys/class/devfreq/15340000.vic/{key}_freq": "1\n" for key in ("min", "max", "cur")})
    assert clocks(tmp_path).level is Level.SKIP


def jetson(root: Path, revision: str = "4.3") -> Path:
    return write(root, {"etc/nv_tegra_release": f"# R36 (release), REVISION: {revision}, GCID: 1\n"})


@pytest.mark.parametrize(
    ("machine", "available", "revision", "level", "text"),
    [
        ("aarch64", [CUDA, CPU_PROVIDER], "4.3", Level.OK, ""),
        ("x86_64", [CUDA], "4.3", Level.FAIL, "export for this machine"),
        ("aarch64", [CUDA], "3.0", Level.FAIL, "JetPack"),
        ("aarch64", [CUDA], "10.0", Level.OK, ""),
        ("aarch64", [CPU_PROVIDER], "4.3", Level.FAIL, "ONNX Runtime package"),
    ],
    ids=["the device itself", "another processor", "an older JetPack", "a newer JetPack", "no provider"],
)
def test_the_machine_is_compared_with_the_one_that_the_artifacts_are_for(
    tmp_path: Path, machine: str, available: list[str], revision: str, level: Level, text: str
) -> None:
    check = match(ORIN, [CUDA], machine, available, jetson(tmp_path, revision))
    assert check.level is level and text in check.advice


def sized(root: Path, cores: int, gib: float, module: str = "") -> Path:
    files = {
        "sys/devices/system/cpu/present": f"0-{cores - 1}\n",
        "proc/meminfo": f"MemTotal: {round(gib * 1024 * 1024)} kB\n",
    }
    return write(root, {**files, **({"proc/device-tree/compatible": f"{module}\0nvidia,tegra234\0"} if module else {})})


@pytest.mark.parametrize(
    ("cores", "gib", "module", "level"),
    [
        (8, 15.3, "nvidia,p3767-0000", Level.OK),
        (6, 7.4, "nvidia,p3767-0001", Level.FAIL),
        (6, 15.3, "", Level.FAIL),
        (8, 7.4, "", Level.FAIL),
        (12, 61.4, "nvidia,p3701-0005", Level.WARN),
        (8, 15.3, "nvidia,p9999-0000", Level.OK),
    ],
)
def test_cores_and_memory_are_held_against_the_target(
    tmp_path: Path, cores: int, gib: float, module: str, level: Level
) -> None:
    check = match(ORIN, [CUDA], "aarch64", [CUDA], sized(jetson(tmp_path), cores, gib, module))
    assert check.level is level
    assert f"{cores} cores" in check.found


def test_an_ordinary_machine_may_have_more_than_its_target_and_a_cards_memory_is_not_the_machines(
    tmp_path: Path,
) -> None:
    card = replace(ORIN, architectures=("x86_64",), min_l4t=None, own_memory=True)
    assert match(card, [CUDA], "x86_64", [CUDA], sized(tmp_path, 24, 4)).level is Level.OK


def test_a_plan_for_a_cards_own_memory_is_not_held_against_the_machines(tmp_path: Path) -> None:
    write(tmp_path, {"proc/meminfo": "MemAvailable:   1048576 kB\n"})
    assert memory(None, tmp_path).level is Level.SKIP
    check = memory(PLAN, tmp_path, own_memory=True)
    assert (check.level, "1.00 GiB" in check.found) == (Level.SKIP, True)


@pytest.mark.parametrize(("gib", "level"), [(3.9, Level.FAIL), (4.1, Level.WARN), (8.0, Level.OK)])
def test_free_memory_is_held_against_the_plan(tmp_path: Path, gib: float, level: Level) -> None:
    write(tmp_path, {"proc/meminfo": f"MemTotal: 16000000 kB\nMemAvailable:   {round(gib * 1024 * 1024)} kB\n"})
    assert memory(PLAN, tmp_path).level is level


@pytest.mark.parametrize(
    ("free_gib", "total_gib", "level"),
    [(7, 100, Level.OK), (6, 100, Level.FAIL), (0, 100, Level.FAIL), (0.5, 4, Level.OK), (0.4, 4, Level.FAIL)],
)
def test_below_seven_percent_or_half_a_gib_of_free_disk_nothing_starts(
    tmp_path: Path, free_gib: float, total_gib: int, level: Level
) -> None:
    assert disk(tmp_path, lambda _folder: (round(free_gib * GIB), total_gib * GIB)).level is level


def test_a_folder_whose_free_space_is_unknown_fails(tmp_path: Path) -> None:
    def refuse(_folder: Path) -> tuple[int, int]:
        raise FileNotFoundError(2, "No such file or directory")

    assert disk(tmp_path, refuse).level is Level.FAIL


UTC = datetime.timezone.utc
MADE = datetime.datetime(2026, 11, 21, tzinfo=UTC)


def clock_check(root: Path, year: int, source: str = "arch_sys_counter") -> Check:
    write(root, {"sys/devices/system/clocksource/clocksource0/current_clocksource": f"{source}\n"})
    return wall_clock(datetime.datetime(year, 1, 1, tzinfo=UTC), MADE, root)


def test_a_wall_clock_before_the_artifacts_and_a_coarse_monotonic_clock_are_warnings(tmp_path: Path) -> None:
    assert clock_check(tmp_path, 2027).level is Level.OK
    assert clock_check(tmp_path, 1970).level is Level.WARN
    assert clock_check(tmp_path, 2027, "jiffies").level is Level.WARN


def process(proc: Path, pid: int, name: str, ticks: int) -> None:
    write(proc, {f"{pid}/stat": f"{pid} ({name}) S 1 1 1 0 -1 4194560 1 0 0 0 {ticks} 0 0 0 20 0 1 0 1 1 1\n"})


def test_processor_time_is_read_for_any_program_name(tmp_path: Path) -> None:
    process(tmp_path, 7, "a) S 9 (b", 50)
    write(tmp_path, {"8/stat": "nonsense", "self/stat": "1 (x) S"})
    assert processor_ticks(tmp_path) == {7: ("a) S 9 (b", 50)}


def test_other_programs_that_compute_are_named_and_this_one_is_not() -> None:
    before = {1: ("robot-ui", 0), 2: ("edge-doctor", 0), 3: ("reused", 0)}
    after = {1: ("robot-ui", 70), 2: ("edge-doctor", 100), 3: ("another", 90), 4: ("new", 99)}
    check = busy_programs(before, after, 100, own=2)
    assert check.level is Level.WARN
    assert check.found == "0.70 cores used by others: robot-ui (pid 1) 0.70"
    assert busy_programs(before, before, 100, own=2).level is Level.OK


def test_only_failures_fail() -> None:
    warning = Check("x", Level.WARN, "found", "expected", "advice")
    assert not failed([warning, skipped("y", "not here")])
    assert failed([warning, Check("z", Level.FAIL, "found", "expected", "advice")])


def test_a_finding_is_printed_without_markup() -> None:
    text = io.StringIO()
    Console(width=100, file=text).print(table([Check("x", Level.FAIL, "[red]found[/]", "expected", "rm [a]")]))
    assert "[red]found[/]" in text.getvalue()
    assert "rm [a]" in text.getvalue()


RULES = {"etc/tic-vla-edge/tic-vla-edge.nft": 'oifname != "eth0" accept'}
ADDRESS = {"sys/class/net/eth0/address": "02:00:00:00:00:01\n"}
ROUTE = (
    "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\nNAME\t00000000\t017BA8C0\t3\t0\t0\t0\t00000000\n"
)


def test_a_cable_of_its_own_behind_the_firewall_is_good(tmp_path: Path) -> None:
    write(tmp_path, ADDRESS | RULES | {"proc/net/route": ROUTE.replace("NAME", "wlan0")})
    check = cable("eth0", tmp_path, kernel_and_systemd((1, NOT_ROOT), "active\n"))
    assert check.level is Level.OK
    assert cable("eth0", tmp_path, kernel_and_systemd((0, 'oifname != "eth0" accept'), "active\n")).level is Level.OK


NOT_ROOT = "Operation not permitted (you must be root)\nnetlink: Error: cache initialization failed"


def kernel_and_systemd(rules: tuple[int, str], state: str) -> Callable[[Sequence[str]], tuple[int, str]]:
    """What `nft list table` and `systemctl is-active` answer."""

    def run(words: Sequence[str]) -> tuple[int, str]:
        if words[0] == "nft":
            assert words == ("nft", "list", "table", "inet", "tic_vla_edge")
            return rules
        assert words == ("systemctl", "is-active", "tic-vla-edge-firewall.service")
        return 0, state

    return run


@pytest.mark.parametrize(
    "rules",
    [(1, "Error: No such file or directory"), (0, 'oifname != "eth1" accept')],
    ids=["flushed", "another cable"],
)
def test_rules_that_the_kernel_has_lost_are_a_warning_although_the_service_is_active(
    tmp_path: Path, rules: tuple[int, str]
) -> None:
    write(tmp_path, ADDRESS | RULES)
    check = cable("eth0", tmp_path, kernel_and_systemd(rules, "active\n"))
    assert check.level is Level.WARN and "the kernel has no such rules for eth0" in check.found


def test_rules_for_another_cable_are_a_warning(tmp_path: Path) -> None:
    write(tmp_path, ADDRESS | {"etc/tic-vla-edge/tic-vla-edge.nft": 'oifname != "eth1" accept'})
    check = cable("eth0", tmp_path, kernel_and_systemd((1, NOT_ROOT), "active\n"))
    assert check.level is Level.WARN and "does not name it" in check.found and "repeat edge-install" in check.advice


@pytest.mark.parametrize(
    ("answer", "state"),
    [
        ("inactive\n", "inactive"),
        ("failed\n", "failed"),
        ("System has not been booted with systemd as init system.\nFailed to connect to bus", "unknown"),
        (FileNotFoundError("systemctl"), "unknown"),
    ],
)
def test_rules_that_are_written_and_not_loaded_are_a_warning(
    tmp_path: Path, answer: str | Exception, state: str
) -> None:
    def run(_words: Sequence[str]) -> tuple[int, str]:
        if isinstance(answer, Exception):
            raise answer
        return 3, answer

    write(tmp_path, ADDRESS | RULES)
    check = cable("eth0", tmp_path, run)
    assert check.level is Level.WARN and check.found.endswith(f"is there, its service is {state}")
    assert "sudo systemctl restart tic-vla-edge-firewall.service" in check.advice


@pytest.mark.parametrize(
    ("files", "level", "found"),
    [
        ({}, Level.FAIL, "no interface eth0"),
        (ADDRESS | RULES | {"sys/class/net/eth0/master": ""}, Level.FAIL, "part of"),
        (ADDRESS | RULES | {"sys/class/net/eth0/phy80211/index": "0"}, Level.WARN, "radio"),
        (ADDRESS | RULES | {"proc/net/route": ROUTE.replace("NAME", "eth0")}, Level.WARN, "default route"),
        (ADDRESS, Level.WARN, "without /etc/tic-vla-edge/tic-vla-edge.nft"),
    ],
    ids=["absent", "bridged", "radio", "routed", "no rules"],
)
def test_every_setting_that_lets_others_reach_the_robot_is_found(
    tmp_path: Path, files: dict[str, str], level: Level, found: str
) -> None:
    write(tmp_path, files)
    check = cable("eth0", tmp_path)
    assert (check.level, found in check.found) == (level, True)


def test_a_simulated_robot_has_no_cable(tmp_path: Path) -> None:
    assert cable("lo", tmp_path).level is Level.SKIP


# --- the next start

BOOT_CONF = "< POWER_MODEL ID=0 NAME=MAXN >\nCPU_ONLINE CORE_0 1\n< POWER_MODEL ID=2 NAME=25W >\n"


@pytest.fixture
def board(tmp_path: Path) -> Path:
    """Files of a Jetson with a watchdog, which starts in MAXN."""
    for folder in ("etc", "dev", "var/lib/nvpmodel", "sys/class/watchdog/watchdog0"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "etc/nvpmodel.conf").write_text(BOOT_CONF)
    (tmp_path / "var/lib/nvpmodel/status").write_text("pmode:0000\nfmode:quiet\n")
    (tmp_path / "dev/watchdog0").touch()
    (tmp_path / "sys/class/watchdog/watchdog0/state").write_text("inactive\n")
    return tmp_path


def setting(board: Path, lines: list[str], ran: list[list[str]], **values: object) -> int:
    args = argparse.Namespace(**{"watchdog": None, "power_mode": None, "dry_run": False, **values})

    def command(words: list[str]) -> tuple[int, str]:
        ran.append(list(words))
        return 0, ""

    return boot.run(args, lines.append, board, command)  # type: ignore[arg-type]


def test_the_watchdog_is_written_for_systemd(board: Path) -> None:
    assert setting(board, [], [], watchdog=30) == 0
    assert "[Manager]\nRuntimeWatchdogSec=30\n" in (board / boot.WATCHDOG_FILE).read_text()


def test_the_power_mode_is_stored_by_its_number(board: Path) -> None:
    ran: list[list[str]] = []
    assert setting(board, [], ran, power_mode="25W") == 0 and ran == [["nvpmodel", "-m", "2"]]


def test_a_power_tool_that_hangs_is_one_clear_line(board: Path) -> None:
    def hang(words: Sequence[str]) -> tuple[int, str]:
        raise subprocess.TimeoutExpired(list(words), 60.0)

    lines: list[str] = []
    args = argparse.Namespace(watchdog=None, power_mode="25W", dry_run=False)
    assert boot.run(args, lines.append, board, hang) == 1
    assert lines[-1].startswith("nvpmodel -m 2: expected an answer within 60 s, found none")


def test_a_dry_run_changes_nothing(board: Path) -> None:
    ran: list[list[str]] = []
    assert setting(board, [], ran, watchdog=30, power_mode="25W", dry_run=True) == 0
    assert not (board / boot.WATCHDOG_FILE).exists() and ran == []


@pytest.mark.parametrize(("values", "said"), [
    ({}, "expected --watchdog S"), ({"watchdog": 0}, "expected 5 to 120 s"), ({"watchdog": 10**9}, "5 to 120 s"),
    ({"power_mode": "99W"}, "MAXN, 25W"),
])  # fmt: skip
def test_what_cannot_be_set_is_one_line_and_changes_nothing(board: Path, values: dict[str, object], said: str) -> None:
    lines: list[str] = []
    ran: list[list[str]] = []
    assert setting(board, lines, ran, **values) == 2
    assert len(lines) == 1 and said in lines[0] and ran == [] and not (board / boot.WATCHDOG_FILE).exists()


def test_a_machine_without_a_watchdog_is_told(board: Path) -> None:
    (board / "dev/watchdog0").unlink()
    lines: list[str] = []
    assert setting(board, lines, [], watchdog=30) == 2 and "no hardware watchdog" in lines[0]


def test_the_doctor_tells_a_watchdog_that_is_not_active(board: Path) -> None:
    found = hardware_watchdog(board)
    assert found.level is Level.WARN and "edge-install boot --watchdog" in found.advice


def test_the_doctor_is_content_with_an_active_watchdog(board: Path) -> None:
    (board / "sys/class/watchdog/watchdog0/state").write_text("active\n")
    (board / "sys/class/watchdog/watchdog0/timeout").write_text("30\n")
    assert hardware_watchdog(board).level is Level.OK


def test_the_doctor_tells_another_power_mode_at_start_up(board: Path) -> None:
    found = boot_power_mode("25W", board)
    assert (found.level, found.found) == (Level.WARN, "MAXN") and "edge-install boot --power-mode 25W" in found.advice


def test_the_doctor_is_content_with_the_stored_power_mode(board: Path) -> None:
    (board / "var/lib/nvpmodel/status").write_text("pmode:0002\n")
    assert boot_power_mode("25W", board).level is Level.OK
