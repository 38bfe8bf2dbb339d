"""What a soak is judged by: slopes with intervals, budget lines, measures."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_hil.soak import cli
from sim_hil.soak.faults import DEFAULT_MENU, SoakInputError, load_menu
from sim_hil.soak.report import write_report
from sim_hil.soak.run import SoakFolder, SoakOptions, soak_result
from sim_hil.soak.verdict import (
    DEFAULT_BUDGET,
    FAIL,
    PASS,
    UNDECIDED,
    BudgetLine,
    Measure,
    Slope,
    applicable,
    is_lost,
    judge,
    load_budget,
    measures,
    slope,
)  # fmt: skip

LIMIT = BudgetLine("x", "here", max=1.0)


def grown(per_h: float, seconds: int = 7200, noise: float = 0.0) -> tuple[list[float], list[float]]:
    times = [float(t) for t in range(seconds)]
    rng = np.random.default_rng(5)
    return times, [100.0 + per_h * t / 3600 + float(rng.normal(0, noise)) for t in times]


def test_a_steady_growth_is_found_per_hour() -> None:
    found = slope(*grown(12.0))
    assert found is not None and found.per_h == pytest.approx(12.0, abs=1e-6)


def test_a_constant_value_has_an_interval_around_zero() -> None:
    found = slope(*grown(0.0, noise=0.5))
    assert found is not None and found.low <= 0.0 <= found.high


def test_the_warm_up_does_not_count() -> None:
    times, values = grown(0.0)
    values = [value + (0.0 if t > 290 else -50.0) for t, value in zip(times, values, strict=True)]
    found = slope(times, values)
    assert found is not None and found.per_h == pytest.approx(0.0, abs=1e-9)


def test_spikes_do_not_move_a_slope() -> None:
    times, values = grown(0.0)
    found = slope(times, [value + (500.0 if t % 97 == 0 else 0.0) for t, value in zip(times, values, strict=True)])
    assert found is not None and abs(found.per_h) < 1e-6


def test_a_short_life_has_no_slope() -> None:
    assert slope(*grown(12.0, seconds=5000)) is None


def test_within_the_limit_passes_and_beyond_it_fails() -> None:
    assert judge(LIMIT, Measure(1.0, "", 5))["verdict"] == PASS
    assert judge(LIMIT, Measure(1.1, "", 5))["verdict"] == FAIL


def test_a_lower_limit_is_one_too() -> None:
    line = BudgetLine("x", "here", min=0.98)
    assert judge(line, Measure(0.99, "", 1))["verdict"] == PASS
    assert judge(line, Measure(0.97, "", 1))["verdict"] == FAIL


def test_growth_whose_interval_reaches_the_limit_is_undecided() -> None:
    assert judge(LIMIT, Measure(2.0, "", 1, low=0.5, high=3.0))["verdict"] == UNDECIDED
    assert judge(LIMIT, Measure(2.0, "", 1, low=1.5, high=3.0))["verdict"] == FAIL


def test_an_unmeasured_line_is_undecided_with_a_reason() -> None:
    found = judge(LIMIT, Measure(None, "", 0, note="too short"))
    assert (found["verdict"], found["why"]) == (UNDECIDED, "too short")


def test_a_soak_without_faults_is_not_judged_by_the_answers_to_them() -> None:
    lines = load_budget(DEFAULT_BUDGET)
    left = applicable(lines, faults=False)
    assert {line.measure for line in lines} - {line.measure for line in left} == {"faults_unanswered"}
    assert applicable(lines, faults=True) == lines


def test_a_soak_without_measurements_is_undecided_with_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = soak_options(tmp_path)
    soak = SoakFolder.create(tmp_path / "out", options)
    result = soak_result(soak, options, load_budget(DEFAULT_BUDGET), None, finished=True)
    assert {line["verdict"] for line in result["budget"]} == {UNDECIDED} == {result["verdict"]}
    assert cli.exit_code(result) == 1
    assert "no data: memory_slope_mib_per_h.edge-run, " in capsys.readouterr().err
    page = write_report(soak, result).read_text(encoding="utf-8")
    assert '<span class="verdict bad">UNDECIDED</span>' in page
    assert "no verdict: 15 of 15 budget lines are undecided" in page


def soak_options(folder: Path) -> SoakOptions:
    return SoakOptions(
        folder, "0" * 64, True, ("hospital",), 0, 0, 60.0, 60.0, 0.8, None, "async", "0", "none", 0, "go2", "default"
    )


@pytest.mark.parametrize("legs_run", [False, True])
def test_a_soak_whose_folder_is_deleted_ends_in_one_line_with_exit_code_1(
    legs_run: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run_legs(soak: SoakFolder, *_: object, **__: object) -> bool:
        shutil.rmtree(soak.path)
        if legs_run:  # the loss is noticed when the samples of the first leg are read
            soak.legs.append({"leg": {"number": 1}, "elapsed_s": 60.0})
            return True
        raise FileNotFoundError(2, "No such file or directory", str(soak.folder(1)))

    monkeypatch.setattr(cli, "options_of", lambda _: soak_options(tmp_path))
    monkeypatch.setattr(cli, "run_legs", run_legs)
    out = tmp_path / "out"
    code = cli.main(["--artifacts", str(tmp_path), "--duration", "1m", "--out", str(out)])
    error = capsys.readouterr().err.strip()
    assert code == 1 and "\n" not in error and f"--out {out}: expected the soak's files to stay" in error
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("config.json", "[]", r"config\.json: expected an object, found list"),
        ("legs/001/analysis.json", "{}", r"legs/001: expected the files of a leg, found damaged ones \(KeyError"),
        ("legs/001/analysis.json", "[" * 100_000, "legs/001: .*nested too deeply"),
        ("legs/001/leg.json", "[]", "legs/001: expected the files of a leg"),
    ],
)
def test_a_damaged_soak_is_not_resumed(tmp_path: Path, name: str, text: str, message: str) -> None:
    options = soak_options(tmp_path)
    soak = SoakFolder.create(tmp_path / "out", options)
    soak.folder(1).mkdir()
    for file in ("samples.jsonl", "events.jsonl"):
        (soak.folder(1) / file).touch()
    (soak.path / name).write_text(text, encoding="utf-8")
    with pytest.raises(SoakInputError, match=message):
        SoakFolder.resume(soak.path, options)


@pytest.mark.parametrize(
    ("name", "limit", "value", "lost"),
    [
        ("stops_unexplained", {"max": 0.0}, 1.0, True),
        ("memory_slope_mib_per_h.edge-run", {"max": 0.954}, 8.0, True),
        ("tick_ms.max", {"max": 100.0}, 120.0, True),
        ("real_time_factor.min", {"min": 0.98}, 0.9, True),
        ("real_time_factor.min", {"max": 0.5}, 0.9, False),
        ("tick_ms.p999", {"max": 100.0}, 120.0, False),
        ("success_percent", {"min": 50.0}, 10.0, False),
        ("stops_unexplained", {"max": 0.0}, 0.0, False),
    ],
)
def test_a_failed_line_is_lost_only_if_no_later_leg_can_mend_it(
    name: str, limit: dict[str, float], value: float, lost: bool
) -> None:
    assert is_lost(judge(BudgetLine(name, "here", **limit), Measure(value, "", 9))) is lost


def test_an_undecided_slope_is_not_lost() -> None:
    line = BudgetLine("memory_slope_mib_per_h.edge-run", "here", max=1.0)
    assert not is_lost(judge(line, Measure(2.0, "MiB/h", 1, low=0.5, high=3.0)))


@pytest.mark.parametrize(
    ("lives", "verdict"),
    [
        ([(0.1, 0.05, 0.2), (2.0, -1.0, 5.0)], UNDECIDED),  # the short life's wide interval is above nobody's low
        ([(0.1, 0.05, 0.2), (2.0, 1.5, 5.0)], FAIL),
        ([(0.1, 0.05, 0.2), (0.3, -1.0, 5.0)], PASS),
        ([(2.0, -1.0, 5.0), (1.5, 1.2, 1.8)], FAIL),
    ],
)
def test_the_life_with_the_worst_verdict_is_judged(lives: list[tuple[float, float, float]], verdict: str) -> None:
    surest = max(lives, key=lambda life: life[1])
    found = Measure(surest[0], "MiB/h", 2, *surest[1:], each=tuple(Slope(*life) for life in lives))
    judged = judge(LIMIT, found)
    assert judged["verdict"] == verdict
    assert "each" not in judged["found"] and "each" not in found.as_json()


def test_a_leg_that_failed_is_no_time_driven_and_fails_the_budget(tmp_path: Path) -> None:
    legs = [empty_leg() | {"why": why} for why in ("duration", "failed: the robot's side ended with exit code 1")]
    assert SoakFolder(tmp_path, legs).elapsed_s == 60.0
    line = next(line for line in load_budget(DEFAULT_BUDGET) if line.measure == "legs_failed")
    judged = judge(line, measures(legs, [[], []])["legs_failed"])
    assert judged["verdict"] == FAIL and is_lost(judged)
    assert judge(line, measures(legs[:1], [[]])["legs_failed"])["verdict"] == PASS
    assert judge(line, measures([], [])["legs_failed"])["verdict"] == UNDECIDED


@pytest.mark.parametrize("name", ["odometry jumps 1 m", "odometry is NaN", "robot reports an error"])
def test_what_every_sample_shows_must_be_found_also_while_the_robot_stands(name: str) -> None:
    silent = {"fault": "odometry-jump", "end_ns": 2, "moved_m": 0.0, "raised_ns": None, "other_ns": None, "name": name}
    unanswered = measures([empty_leg() | {"faults": [silent]}], [[]], load_menu(DEFAULT_MENU))["faults_unanswered"]
    assert unanswered.value == 1


def empty_leg() -> dict[str, Any]:
    lists = ("lives", "life_ends", "command_gap_ms", "command_ns", "tasks", "drift", "faults", "stalls")
    nothing = {"real_time_factor": None, "nearest_person": None, "elapsed_s": 60.0, "begin_ns": 0, "why": "duration"}
    return {**{key: [] for key in lists}, **nothing}


def test_a_stall_of_the_machine_is_reported_and_not_counted_as_the_bridges_jitter() -> None:
    ms = 1_000_000
    leg = empty_leg() | {
        "command_gap_ms": [20.0, 50.0],
        "command_ns": [20 * ms, 70 * ms],
        "stalls": [[38 * ms, 69 * ms]],
    }
    found = measures([leg], [[]])
    assert found["bridge_jitter_ms.max"].value == pytest.approx(1.0)
    assert found["bridge_jitter_with_stalls_ms.max"].value == pytest.approx(30.0)
    assert found["machine_stall_ms.max"].value == pytest.approx(31.0) and not found["machine_stall_ms.max"].note


def test_stalls_that_could_not_be_measured_are_named_and_subtract_nothing() -> None:
    leg = empty_leg() | {"command_gap_ms": [50.0], "command_ns": [50_000_000], "stalls": None}
    found = measures([leg, empty_leg()], [[], []])
    assert found["bridge_jitter_ms.max"].value == pytest.approx(30.0)
    assert "not measured in 1 legs" in found["machine_stall_ms.max"].note


def test_the_coverage_counts_the_kinds_of_the_menu_that_were_injected() -> None:
    leg = empty_leg()
    fault = {"fault": "camera-frozen", "end_ns": 2, "moved_m": 1.0, "raised_ns": 1, "other_ns": None}
    leg["faults"] = [{**fault, "name": "camera freezes"}, {**fault, "name": "camera freezes"}]
    menu = load_menu(DEFAULT_MENU)
    faults = tuple(one for one in menu.faults if one.name in ("camera freezes", "camera stops"))
    found = measures([leg], [[]], replace(menu, faults=faults))
    assert found["faults_covered_percent"].value == 50.0
    assert measures([leg], [[]])["faults_covered_percent"].value is None


@pytest.mark.parametrize(("moved_m", "counted"), [(0.05, 0), (0.2, 1), (0.3, 2)])
def test_a_fault_must_be_found_once_the_robot_has_driven_as_far_as_the_menu_says(moved_m: float, counted: int) -> None:
    """A frozen picture with a clock is found by distance, one without at the first motion."""
    silent = {"fault": "camera-frozen", "end_ns": 2, "moved_m": moved_m, "raised_ns": None, "other_ns": None}
    leg = empty_leg() | {"faults": [{**silent, "name": n} for n in ("camera freezes", "clock in a frozen picture")]}
    unanswered = measures([leg], [[]], load_menu(DEFAULT_MENU))["faults_unanswered"]
    assert unanswered.count == counted and unanswered.value == (counted or None)


@pytest.mark.parametrize(
    ("measure", "lines", "message"),
    [
        ("stops", "max = 1.0\nmin = 0.0", None),
        ("stops", "", None),
        ("stops", "max = nan", None),
        ("stops", "most = 1.0", None),
        ("y", "max = 1.0", "no measure 'y'"),
    ],
)
def test_a_wrong_budget_is_refused(tmp_path: Path, measure: str, lines: str, message: str | None) -> None:
    path = tmp_path / "budget.toml"
    path.write_text(f'format = 1\n[[budget]]\nmeasure = "{measure}"\nsource = "here"\n{lines}\n', encoding="utf-8")
    with pytest.raises(SoakInputError, match=message):
        load_budget(path)


def sample(t: float, rss_mib: float, pid: int = 7) -> dict[str, object]:
    row = {"pid": pid, "cpu_percent": 10.0, "rss_bytes": rss_mib * 2**20, "fds": 14, "threads": 3}
    return {"elapsed_s": t, "processes": {"edge-run": row}}


def test_a_leaking_runner_fails_and_a_steady_one_passes() -> None:
    for growth, wanted in ((3.0, FAIL), (0.1, PASS)):
        leg = [sample(float(t), 250 + growth * t / 3600) for t in range(5500)]
        lines = {line.measure: line for line in load_budget(DEFAULT_BUDGET)}
        found = measures([], [leg])
        for name, verdict in (("memory_slope_mib_per_h.edge-run", wanted), ("descriptor_slope_per_h.edge-run", PASS)):
            assert judge(lines[name], found[name])["verdict"] == verdict


def test_every_process_has_a_life_of_its_own() -> None:
    """A runner that is started anew at another size has not grown."""
    leg = [sample(float(t), 250, 7) for t in range(5500)] + [sample(5500.0 + t, 300, 8) for t in range(5500)]
    found = measures([], [leg])["memory_slope_mib_per_h.edge-run"]
    assert found.value == pytest.approx(0.0, abs=1e-6) and found.count == 2
