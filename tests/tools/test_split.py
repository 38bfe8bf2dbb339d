"""The split of the loss: one link is the truth, the others stay the model's; runs continue, differences are paired."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE
from edge.core.geometry import SE2
from edge.reasoning.decoding_rules import ONWARD, DecodingContext, TurnDistances
from edge.reasoning.prompt import InstructionError
from edge.state.reasoning_text import Plan, Progress, ReasoningText, SeenObject, Situation, Stop, Turn, format_text
from sim_hil.benchmark.results.store import StoreError
from tests.support.benchmark import dynanav_fakes as fakes
from tools.findings import split, split_worker
from tools.findings.split_policies import VARIANTS, TrueDistances, TrueProgress, WholeText, _dense
from tools.findings.split_worker import SplitJob, code, messages, result_path, scenario_of

END = 7
TRUTH = ReasoningText(
    Situation("corridor"), (SeenObject("doorway", "left", 5),), (), Progress(2, 2, 0),
    Plan(Turn("left", "room", 4)), ((1.0, 0.0), (2.0, 0.0), (3.0, 1.0)),
)  # fmt: skip


def encode(text: str) -> list[int]:
    """One token a character."""
    return [ord(character) for character in text]


def decode(ids: Any) -> str:
    return "".join(chr(token) for token in ids)


def test_a_whole_text_is_forced_token_by_token_and_then_ends() -> None:
    constraint = WholeText(DecodingContext(), encode, TRUTH, END)
    expected = format_text(TRUTH)
    assert decode(constraint.forced()) == expected
    assert decode(constraint.choose(0) for _ in expected) == expected
    assert constraint.choose(0) == END
    constraint.replace_line("Plan: turn left into the room in 4 m.")
    assert constraint.has_plan and constraint.turn is not None and constraint.turn.distance_m == 4.0


def test_the_true_progress_replaces_another_and_the_rest_of_the_text_stays_the_models() -> None:
    context = DecodingContext(Progress(1, 2, 0), ONWARD, turn_may_be_done=False)
    constraint = TrueProgress(context, encode, TRUTH, END)
    written = "Progress: turn 1 of 2, passed 0.\nPlan: stop now.\n"
    chosen = decode([constraint.choose(token) for token in encode(written)])
    assert chosen.startswith("Progress: turn 2 of 2, passed 0.\n") and chosen.endswith("Plan: stop now.\n")
    assert not constraint.overruled and constraint.refused is None


def test_true_distances_replace_objects_and_the_distance_of_the_same_plan() -> None:
    context = DecodingContext(turn=TurnDistances("left", (1.0,)))
    constraint = TrueDistances(context, encode, TRUTH, END)
    objects = constraint.replace_line("Objects: doorway right 9 m.")
    plan = constraint.replace_line("Plan: wait, then turn left into the room in 8 m.")
    assert decode(objects or ()) == "Objects: doorway left 5 m.\n"
    assert decode(plan or ()) == "Plan: wait, then turn left into the room in 4 m.\n"


@pytest.mark.parametrize(
    "line", ["Plan: turn right into the room in 8 m.", "Plan: stop in 8 m.", "Motion: nobody near."]
)
def test_true_distances_keep_what_the_model_means(line: str) -> None:
    assert TrueDistances(DecodingContext(), encode, TRUTH, END).replace_line(line) is None


def test_a_route_of_waypoints_begins_at_the_anchor_and_passes_through_them() -> None:
    line = _dense(SE2(2.0, 1.0, np.pi / 2), ((1.0, 0.0), (2.0, 0.0), (2.0, -1.0)))
    assert line[0] == pytest.approx((2.0, 1.0)) and line[-1] == pytest.approx((3.0, 3.0), abs=0.11)
    assert np.hypot(*(line - (2.0, 3.0)).T).min() < 0.06
    assert np.hypot(*np.diff(line, axis=0).T).max() < 0.101


@pytest.mark.slow
def test_scenarios_are_of_the_benchmarks_buildings_and_of_a_seed_that_no_stage_uses() -> None:
    scenario = scenario_of(3)
    assert scenario.kind in ("hospital", "office", "warehouse") and scenario.layout_seed >= 100
    assert scenario.episode == scenario_of(3).episode
    assert len({scenario_of(number).layout_seed for number in range(4)}) == 4


def store(out: Path, variant: str, reached: str) -> None:
    """Write results of one variant: "1" reached, "0" missed, " " none."""
    for number, mark in enumerate(reached):
        if mark == " ":
            continue
        made = fakes.result(f"e{number}") if mark == "1" else fakes.missed(f"e{number}")
        path = result_path(out, variant, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(made.as_json()), encoding="utf-8")


def test_gains_are_paired_over_the_episodes_that_both_variants_have(tmp_path: Path) -> None:
    store(tmp_path, "ours", "0011001100")
    store(tmp_path, "expert-text", "11111111  ")
    rows = split.table(tmp_path)["variants"]
    assert list(rows) == ["ours", "expert-text"]
    assert rows["ours"]["sr"] == 40 and rows["ours"]["sr_gain"] == 0
    row = rows["expert-text"]
    assert (row["episodes"], row["pairs"], row["sr"], row["sr_gain"]) == (8, 8, 100, 50)
    low, high = row["sr_gain_ci95"]
    assert 0 < low < 50 < high <= 100


def test_the_table_can_be_written_while_a_run_is_unfinished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store(tmp_path, "ours", "01")
    assert split.main(["--out", str(tmp_path), "--report"]) == EXIT_DONE
    page = capsys.readouterr().out
    assert "| `ours` | our text, our action expert | 2 | 50.0" in page and page == (tmp_path / "split.md").read_text()


def test_a_table_without_results_is_a_failure(tmp_path: Path) -> None:
    assert split.main(["--out", str(tmp_path), "--report"]) == EXIT_CHECK_FAILED
    assert split.main(["--out", str(tmp_path / "none"), "--report"]) == EXIT_BAD_INPUT
    assert list(tmp_path.glob("none*")) == []


@pytest.mark.slow
def test_a_run_of_other_artifacts_or_latency_is_not_continued(tmp_path: Path) -> None:
    split.check_same_run(tmp_path, "a" * 64, 1.0)
    split.check_same_run(tmp_path, "a" * 64, 1.0)
    with pytest.raises(StoreError, match="latency_s"):
        split.check_same_run(tmp_path, "a" * 64, 2.0)
    with pytest.raises(StoreError, match="manifest_sha256"):
        split.check_same_run(tmp_path, "b" * 64, 1.0)


def job(folder: Path, *variants: str, version: str | None = None) -> dict[str, Any]:
    """A job as a worker reads it from its standard input."""
    return json.loads(json.dumps(vars(SplitJob(str(folder), "a", 1.0, 3, variants, "0" * 64, version or code()))))


def test_a_worker_goes_on_after_a_variant_that_cannot_be_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drive(order: SplitJob, scenario: object, name: str) -> Any:
        if name == "expert-text":
            raise InstructionError("too long")
        return fakes.result("e3")

    monkeypatch.setattr(split_worker, "scenario_of", lambda number: None)
    monkeypatch.setattr(split_worker, "run_variant", drive)
    first, second = messages(job(tmp_path, "expert-text", "ours"))
    assert first == {"failed": "expert-text", "why": "too long"}
    assert second["done"] == "ours" and result_path(tmp_path, "ours", 3).is_file()


def test_a_worker_with_other_code_than_the_runs_drives_nothing(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="code has changed"):
        next(iter(messages(job(tmp_path, "ours", version="0" * 64))))


def test_results_of_another_task_are_not_paired(tmp_path: Path) -> None:
    store(tmp_path, "ours", "01")
    store(tmp_path, "expert-text", "11")
    path = result_path(tmp_path, "expert-text", 1)
    path.write_text(path.read_text().replace('"task": "', '"task": "another-'))
    with pytest.raises(StoreError, match=r"expert-text/0001\.json"):
        split.table(tmp_path)


def test_the_rates_of_each_kind_of_building_are_given(tmp_path: Path) -> None:
    store(tmp_path, "ours", "01")
    for number, scene in enumerate(("office-123", "warehouse-7")):
        path = result_path(tmp_path, "ours", number)
        path.write_text(json.dumps({**json.loads(path.read_text()), "scene": scene}))
    content = split.table(tmp_path)
    assert content["variants"]["ours"]["sr_by_kind"] == {"hospital": None, "office": 0, "warehouse": 100}
    assert "| SR hospital | SR office | SR warehouse |" in split.markdown(content)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--variants", "magic"), "--variants 'magic'"),
        (("--jobs", "0"), "1 to 256 jobs"),
        (("--latency", "nan"), "latency up to 60 s"),
        ((), "--artifacts"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert split.main(["--out", str(tmp_path / "out"), *arguments]) == EXIT_BAD_INPUT
    found = capsys.readouterr().err
    assert message in found and found.count("\n") == 1


def test_the_plan_of_a_stop_gets_the_true_distance() -> None:
    truth = ReasoningText(plan=Plan(Stop(3)))
    found = TrueDistances(DecodingContext(), encode, truth, END).replace_line("Plan: stop in 8 m.")
    assert decode(found or ()) == "Plan: stop in 3 m.\n"


def test_every_variant_has_a_description_of_its_own() -> None:
    assert len({variant.description for variant in VARIANTS.values()}) == len(VARIANTS) == 10
