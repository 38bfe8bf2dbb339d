"""Random faults of a soak: the menu's file, and a schedule that the same seed repeats."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.safety.faults.table import FAULTS, Action
from sim_hil.soak.faults import DEFAULT_MENU, FaultMenu, FaultSchedule, Injector, SoakFault, SoakInputError, load_menu

ONE = """
format = 1
gap_s = [1.0, 2.0]
[[faults]]
name = "camera stops"
inject = "camera-stop"
for_s = [0.5, 1.0]
weight = 1.0
fault = "camera-stopped"
expect = "zero"
"""


def drawn(seed: int, leg: int, count: int = 40) -> list[tuple[str, float, float]]:
    schedule = FaultSchedule(load_menu(DEFAULT_MENU), seed, leg)
    injections = [schedule.next() for _ in range(count)]
    return [(one.fault.name, one.gap_s, one.for_s) for one in injections]


def test_the_same_seed_and_leg_give_the_same_faults_and_others_give_others() -> None:
    assert drawn(3, 1) == drawn(3, 1)
    assert drawn(3, 1) != drawn(4, 1) and drawn(3, 1) != drawn(3, 2)


def test_gaps_and_lengths_are_within_their_ranges() -> None:
    menu = load_menu(DEFAULT_MENU)
    ranges = {fault.name: fault.for_s for fault in menu.faults}
    for name, gap_s, for_s in drawn(0, 1, 300):
        assert menu.gap_s[0] <= gap_s <= menu.gap_s[1] and ranges[name][0] <= for_s <= ranges[name][1]


def test_faults_are_drawn_in_proportion_to_their_weights() -> None:
    rare = SoakFault("rare", "camera-stop", (1.0, 1.0), 1.0, "", "zero")
    often = SoakFault("often", "camera-freeze", (1.0, 1.0), 9.0, "", "zero")
    schedule = FaultSchedule(FaultMenu((1.0, 1.0), (rare, often)), 0, 1)
    names = [schedule.next().fault.name for _ in range(1000)]
    assert 820 < names.count("often") < 960


def test_faults_that_end_the_run_are_put_off_until_they_may_come_and_none_is_lost() -> None:
    lasting = SoakFault("camera", "camera-stop", (1.0, 1.0), 9.0, "", "zero")
    ending = SoakFault("error", "error-code", (1.0, 1.0), 1.0, "", "stop")
    schedule = FaultSchedule(FaultMenu((5.0, 5.0), (lasting, ending)), 0, 1)
    stack: Any = SimpleNamespace(faults=SimpleNamespace(answers=tuple, ask=lambda *_, **__: None))
    injected: list[tuple[str, int]] = []
    now_s = 0
    injector = Injector(stack, schedule, lambda kind, **about: injected.append((about["name"] + kind, now_s)))
    injector.stops_from_ns = round(1000 * 1e9)
    for now_s in range(1500):
        injector.step(round(now_s * 1e9))

    ended_s = [at_s for name, at_s in injected if name == "errorfault_on"]
    assert min(ended_s) >= 1000
    assert len(ended_s) > 15, "those of 1,000 s, about one in ten of 140, and of 500 s more"


def test_default_faults_expect_the_action_of_the_fault_table() -> None:
    for fault in load_menu(DEFAULT_MENU).faults:
        if fault.fault:
            entry = FAULTS[fault.fault]
            action = "stop" if entry.latch else {Action.LIMIT: "limit", Action.ZERO: "zero"}[entry.action]
            assert fault.expect == action, fault.name


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("weight = 1.0", "weight = 0.0", "weight"),
        ("weight = 1.0", "wieght = 1.0", "weight"),
        ("weight = 1.0", "weight = 1.0\nwieght = 1.0", "wieght"),
        ('"camera-stop"', '"camera-stops"', "camera-stop"),
        ('"camera-stopped"', '"camera-gone"', "camera-gone"),
        ('expect = "zero"', 'expect = "panic"', "panic"),
        ("for_s = [0.5, 1.0]", "for_s = [1.0, 0.5]", "for_s"),
        ("gap_s = [1.0, 2.0]", "gap_s = [0.0, 2.0]", "gap_s"),
        ('inject = "camera-stop"', 'inject = "process:edge-hil:SIGKILL"', "process:NAME:SIGNAL"),
        ("weight = 1.0", "weight = 1.0\nvalues = { delay_s = 1.0 }", "delay_s"),
        ("weight = 1.0", "weight = 1.0\nvalues = 3", "values"),
        ("weight = 1.0", "weight = 1.0\nmoved_m = -0.1", "moved_m"),
        ("format = 1", "format = 2", "format"),
    ],
)
def test_an_invalid_menu_is_refused_in_one_line(tmp_path: Path, old: str, new: str, named: str) -> None:
    assert old in ONE
    path = tmp_path / "faults.toml"
    path.write_text(ONE.replace(old, new), encoding="utf-8")
    with pytest.raises(SoakInputError) as error:
        load_menu(path)
    assert named in str(error.value) and "\n" not in str(error.value)
