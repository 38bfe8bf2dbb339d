"""Random faults of a soak: the menu's file, and a schedule that the same seed repeats."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.safety.faults.table import FAULTS, Action
from sim_hil.soak.drive import schedule
from sim_hil.soak.drive.schedule import FaultMenu, FaultSchedule, SoakFault, SoakInputError, load_menu

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


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "faults.toml"
    path.write_text(text, encoding="utf-8")
    return path


def first(seed: int, leg: int, count: int = 40) -> list[tuple[str, float, float]]:
    one = FaultSchedule(load_menu(schedule.DEFAULT), seed, leg)
    drawn = [one.next() for _ in range(count)]
    return [(injection.fault.name, injection.gap_s, injection.for_s) for injection in drawn]


def test_the_same_seed_gives_the_same_faults() -> None:
    assert first(3, 1) == first(3, 1)


def test_another_seed_or_leg_gives_others() -> None:
    assert first(3, 1) != first(4, 1) and first(3, 1) != first(3, 2)


def test_gaps_and_lengths_are_within_their_ranges() -> None:
    menu = load_menu(schedule.DEFAULT)
    ranges = {fault.name: fault.for_s for fault in menu.faults}
    for name, gap_s, for_s in first(0, 1, 300):
        assert menu.gap_s[0] <= gap_s <= menu.gap_s[1] and ranges[name][0] <= for_s <= ranges[name][1]


def test_weights_say_how_often() -> None:
    rare = SoakFault("rare", "camera-stop", (1.0, 1.0), 1.0, "", "zero")
    often = SoakFault("often", "camera-freeze", (1.0, 1.0), 9.0, "", "zero")
    one = FaultSchedule(FaultMenu((1.0, 1.0), (rare, often)), 0, 1)
    names = [one.next().fault.name for _ in range(1000)]
    assert 820 < names.count("often") < 960


def test_most_of_the_default_faults_can_be_driven_on_from() -> None:
    menu = load_menu(schedule.DEFAULT)
    total = sum(fault.weight for fault in menu.faults)
    assert sum(fault.weight for fault in menu.faults if fault.expect == "stop") < 0.1 * total


def test_default_faults_expect_what_the_fault_table_says() -> None:
    for fault in load_menu(schedule.DEFAULT).faults:
        if fault.fault:
            known = FAULTS[fault.fault]
            action = "stop" if known.latch else {Action.LIMIT: "limit", Action.ZERO: "zero"}[known.action]
            assert fault.expect == action, fault.name


def test_a_menu_is_read_as_it_is_written(tmp_path: Path) -> None:
    menu = load_menu(written(tmp_path, ONE))
    assert menu.gap_s == (1.0, 2.0) and menu.faults[0].inject == "camera-stop"


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("weight = 1.0", "weight = 0.0", "weight"),
        ("weight = 1.0", "wieght = 1.0", "wieght"),
        ('"camera-stop"', '"camera-stops"', "camera-stop"),
        ('"camera-stopped"', '"camera-gone"', "camera-gone"),
        ('expect = "zero"', 'expect = "panic"', "panic"),
        ("for_s = [0.5, 1.0]", "for_s = [1.0, 0.5]", "for_s"),
        ("gap_s = [1.0, 2.0]", "gap_s = [0.0, 2.0]", "gap_s"),
        ('inject = "camera-stop"', 'inject = "process:edge-hil:SIGKILL"', "process:NAME:SIGNAL"),
        ("weight = 1.0", "weight = 1.0\nvalues = { delay_s = 1.0 }", "delay_s"),
        ("format = 1", "format = 2", "format"),
    ],
)
def test_a_menu_that_is_wrong_is_refused_in_one_line(tmp_path: Path, old: str, new: str, named: str) -> None:
    assert old in ONE
    with pytest.raises(SoakInputError) as error:
        load_menu(written(tmp_path, ONE.replace(old, new)))
    assert named in str(error.value) and "\n" not in str(error.value)
