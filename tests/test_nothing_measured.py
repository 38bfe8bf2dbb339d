"""A check that has measured nothing has not passed, in whatever command."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.core.cli import EXIT_CHECK_FAILED
from edge.core.stats import Samples
from edge.flightlog.replay.command import Tolerance, verdict
from edge.flightlog.replay.policy import Comparison
from edge.reasoning.generation_cycle import GenerationCycle, ReasoningConfig
from edge.run import command as runner
from edge.run.control_loop import ControlStatistics
from edge.run.result import run_result
from edge.state.switches import Switches
from sim_hil.benchmark import cli as bench_cli
from sim_hil.benchmark import runs
from sim_hil.benchmark.suite import validate
from tests.support.processes import GO2_SIM
from tests.support.runner import synthetic_run
from tools.faults.report import RowResult, result
from tools.faults.rows import rows
from tools.report.checks import acceptance
from tools.report.demo_report import RunFiles, load_run


def test_a_replay_of_no_tick_is_not_equal() -> None:
    texts_only = Comparison()
    texts_only.generations = texts_only.texts_equal = 3
    assert any("no tick" in line for line in verdict(texts_only, Tolerance(0.1, 0.1, 0.005)))


def test_faults_without_a_row_do_not_pass() -> None:
    assert result([], {}, "go2")["pass"] is False


def test_a_row_without_an_injection_does_not_pass() -> None:
    assert RowResult(rows()[0], []).problems == ["no injection"]
    assert result([RowResult(rows()[0], [])], {}, "go2")["pass"] is False


def test_a_suite_without_episodes_is_not_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validate, "load_suite", lambda name: [])
    assert validate.main([]) == EXIT_CHECK_FAILED


def test_a_demo_without_ticks_and_generations_fails_by_both(tmp_path: Path) -> None:
    """A drive so short that the counts expected of it round to zero."""
    synthetic_run.write_run(tmp_path, 6.0)
    data = load_run(RunFiles(tmp_path, tmp_path / "artifacts"))
    data.settings["duration_s"] = 0.01
    run = data.results["edge-run"]
    run["duration_s"], run["control"]["ticks"], run["reasoning"]["generations"] = 0.01, 0, 0
    failed = {check.name for check in acceptance(data) if not check.passed}
    assert {"control_ticks", "generations"} <= failed


def test_a_benchmark_without_a_result_does_not_pass(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runs, "run_all", lambda *_, **__: True)
    arguments = ["--suite", "dynanav", "--policy", "expert", "--episodes", "*hospital*", "--json", "-"]
    assert bench_cli.main(arguments) == EXIT_CHECK_FAILED
    assert "nothing was measured" in capsys.readouterr().err


def test_a_run_without_a_finite_plan_is_a_fault_with_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    control = SimpleNamespace(
        statistics=ControlStatistics(ticks=5, plans=5, plans_not_finite=5),
        supervision=SimpleNamespace(state=SimpleNamespace(value="zero")),
    )
    reasoning = SimpleNamespace(
        cycle=GenerationCycle(ReasoningConfig((), 0)),
        times=SimpleNamespace(generation_ms=Samples(), anchor_to_ready_ms=Samples(), late_anchor_ms=Samples()),
        gave_way_ns=0,
    )
    inputs = SimpleNamespace(
        camera=SimpleNamespace(frames=1, failures=0), odometry=None, states=1,
        estimator=SimpleNamespace(rejected={}, visual_used=0, visual_rejected=0),
    )  # fmt: skip

    class Session:
        hung = False

        def __init__(self, *_: object) -> None: ...
        def request_stop(self) -> None: ...
        def run(self) -> dict[str, Any]:
            made: Any = run_result
            return dict(made(control, reasoning, inputs, None, Switches(), power_w={}, faults=[], duration_s=1.0))

    monkeypatch.setattr(runner, "RunSession", Session)
    monkeypatch.setattr(runner, "load_artifacts", lambda *_: SimpleNamespace(trained=True, directory=tmp_path))
    monkeypatch.setattr(runner.engines, "check", lambda *_: SimpleNamespace(check_unchanged=lambda: None))
    monkeypatch.setattr(runner.engines, "with_engines", lambda artifacts, _: artifacts)
    monkeypatch.setattr(runner.signal, "signal", lambda *_: None)
    out = tmp_path / "run.json"
    arguments = ["--artifacts", str(tmp_path), "--robot", str(GO2_SIM), "--instruction", "go on", "--json", str(out)]
    assert runner.main(arguments) == EXIT_CHECK_FAILED
    assert "none of the 5 plans was finite" in capfd.readouterr().err
    assert json.loads(out.read_text())["faults"][0].startswith("output-not-finite")
