"""The gate's arithmetic: what is measured on a graph, and what a target's thresholds make of it."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from export.evaluation.gates import GateError, GateResult, Verdict, judge, require
from export.evaluation.parity import Arrays, ParityError, ParityResult, Sample, compare
from export.evaluation.task_error import TaskResult
from export.targets.sections import GraphGate, TaskGate

GATE = GraphGate(inputs=2, min_cosine=0.99, max_abs=0.1, min_difference=1e-3, warn_cosine=0.999, top1=0.9)
TASK_GATE = TaskGate(
    waypoint_cm=5, heading_deg=2, speed_mps=0.05, turn_radps=0.1, warn_waypoint_cm=2, warn_heading_deg=1
)
GOOD = ParityResult(inputs=2, cosine=0.9999, max_abs=0.01, min_difference=0.5, top1=1.0)
STEADY = TaskResult(1, 0.5, 0.01, 0.01, relative=0.02, by_delay_cm=((0.0, 0.5), (10.0, 1.0)), semantic=0.4)


def samples(count: int = 3) -> list[Sample]:
    rng = np.random.default_rng(0)
    return [
        Sample({"x": (x := rng.standard_normal((1, 4)).astype(np.float32))}, {"visual_tokens": 2 * x})
        for _ in range(count)
    ]


def doubled(feeds: Arrays) -> Arrays:
    return {"visual_tokens": 2 * feeds["x"]}


def tokens(logits: list[list[float]]) -> Sample:
    return Sample({}, {"logits": np.array(logits, dtype=np.float32)})


# ---- what is measured


def test_the_same_outputs_are_exactly_the_same() -> None:
    found = compare("vision_encoder", samples(), doubled)
    assert (found.cosine, found.max_abs, found.inputs, found.top1) == (1.0, 0.0, 3, None)
    assert found.min_difference > 0


def test_the_share_of_equal_tokens_is_counted_over_all_inputs() -> None:
    expected = [tokens([[0, 1]]), tokens([[1, 0]]), tokens([[0, 3]]), tokens([[5, 0]])]
    answers = iter([[[0.0, 2.0]], [[1.0, 0.1]], [[9.0, 3.0]], [[5.0, 0.0]]])
    found = compare("language_model", expected, lambda _: {"logits": np.array(next(answers))})
    assert found.top1 == 0.75


def test_a_chosen_token_alone_counts_too() -> None:
    expected = [Sample({}, {"next_token": np.array([[n]])}) for n in (1, 2)]
    found = compare("language_model", expected, lambda _: {"next_token": np.array([[2]])})
    assert (found.top1, found.max_abs) == (0.5, 0.0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({}, "gives no 'visual_tokens'"),
        ({"visual_tokens": np.zeros((1, 5))}, r"visual_tokens is \[1, 5\], PyTorch gives \[1, 4\]"),
        ({"visual_tokens": np.full((1, 4), np.nan)}, "not finite"),
        ({"visual_tokens": np.full((1, 4), np.inf)}, "not finite"),
    ],
)
def test_outputs_that_cannot_be_compared_are_named(answer: Arrays, message: str) -> None:
    with pytest.raises(ParityError, match=f"vision_encoder: .*{message}"):
        compare("vision_encoder", samples(), lambda _: answer)


def test_one_input_is_not_enough_for_the_negative_control() -> None:
    with pytest.raises(ValueError, match="two or more"):
        compare("vision_encoder", samples(1), doubled)


# ---- what it is held to


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cosine": 0.98}, "cosine 0.98 (≥ 0.99)"),
        ({"max_abs": 0.2}, "max-abs 0.2 (≤ 0.1)"),
        ({"min_difference": 0.0}, "difference between inputs 0 (≥ 0.001)"),
        ({"top1": 0.5}, "same token 0.5 (≥ 0.9)"),
        ({"cosine": float("nan")}, "cosine nan (≥ 0.99)"),
        ({"max_abs": float("nan")}, "max-abs nan (≤ 0.1)"),
    ],
)
def test_every_tensor_threshold_fails_alone(change: dict[str, float], message: str) -> None:
    verdict = judge(replace(GOOD, **change), STEADY, GATE, TASK_GATE)
    assert verdict.level == "FAIL"
    assert message in verdict.reasons


def test_a_model_that_ignores_its_input_fails_though_its_graph_is_exactly_that_model() -> None:
    constant = [replace(sample, expected=samples()[0].expected) for sample in samples()]
    found = compare("vision_encoder", constant, lambda _: constant[0].expected)
    assert (found.cosine, found.max_abs, found.min_difference) == (1.0, 0.0, 0.0)
    assert judge(found, None, GATE, TASK_GATE) == Verdict("FAIL", ("difference between inputs 0 (≥ 0.001)",))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"waypoint_cm": 6}, "waypoint error in cm 6 (≤ 5)"),
        ({"heading_deg": 3}, "heading error in deg 3 (≤ 2)"),
        ({"speed_mps": 0.06}, "speed command error in m/s 0.06 (≤ 0.05)"),
        ({"turn_radps": 0.2}, "turn command error in rad/s 0.2 (≤ 0.1)"),
        ({"waypoint_cm": float("nan")}, "waypoint error in cm nan (≤ 5)"),
        ({"relative": 1.5}, "deviation as a share of the plans' spread 1.5 (≤ 1)"),
        ({"relative": None}, "deviation as a share of the plans' spread inf (≤ 1)"),
        ({"kv_cosine": 0.5}, "cosine of the semantic state 0.5 (≥ 0.9)"),
        ({"token_agreement": 0.0}, "share of the same text 0 (≥ 0.1)"),
    ],
)
def test_every_task_threshold_fails_alone(change: dict[str, float], message: str) -> None:
    verdict = judge(GOOD, replace(STEADY, **change), GATE, TASK_GATE)
    assert verdict == Verdict("FAIL", (message,))


@pytest.mark.parametrize(
    ("parity", "task", "message"),
    [
        (replace(GOOD, cosine=0.995), STEADY, "cosine 0.995 (≥ 0.999)"),
        (GOOD, replace(STEADY, waypoint_cm=3), "waypoint error in cm 3 (≤ 2)"),
        (GOOD, replace(STEADY, heading_deg=1.5), "heading error in deg 1.5 (≤ 1)"),
        (GOOD, replace(STEADY, relative=0.7), "deviation as a share of the plans' spread 0.7 (≤ 0.5)"),
        (GOOD, replace(STEADY, kv_cosine=0.95), "cosine of the semantic state 0.95 (≥ 0.97)"),
        (GOOD, replace(STEADY, token_agreement=0.3), "share of the same text 0.3 (≥ 0.5)"),
    ],
)
def test_between_two_thresholds_it_warns_with_the_reason(parity: ParityResult, task: TaskResult, message: str) -> None:
    assert judge(parity, task, GATE, TASK_GATE) == Verdict("WARN", (message,))


def test_another_token_from_untrained_weights_only_warns() -> None:
    unsure = replace(GOOD, top1=0.5)
    assert judge(unsure, STEADY, GATE, TASK_GATE, trained=False).level == "WARN"
    assert judge(unsure, STEADY, GATE, TASK_GATE, trained=True).level == "FAIL"
    assert judge(replace(unsure, cosine=0.5), STEADY, GATE, TASK_GATE, trained=False).level == "FAIL"


def test_text_of_untrained_weights_is_not_judged_but_their_plans_and_state_are() -> None:
    assert judge(GOOD, replace(STEADY, token_agreement=0.0), GATE, TASK_GATE, trained=False) == Verdict("PASS")
    for change in ({"relative": 1.5}, {"kv_cosine": 0.5}):
        assert judge(GOOD, replace(STEADY, **change), GATE, TASK_GATE, trained=False).level == "FAIL"


@pytest.mark.parametrize("semantic", [0.0, 0.005, None, float("nan")])
def test_plans_that_do_not_follow_the_semantic_state_warn_that_the_task_cannot_tell(semantic: float | None) -> None:
    verdict = judge(GOOD, replace(STEADY, semantic=semantic), GATE, TASK_GATE)
    assert verdict.level == "WARN"
    assert "hardly depend on the semantic state" in verdict.reasons[0]


def test_thresholds_that_a_target_does_not_give_do_not_judge() -> None:
    gate = replace(GATE, warn_cosine=None, top1=None)
    assert judge(replace(GOOD, cosine=0.991, top1=0.0), None, gate, TASK_GATE) == Verdict("PASS")


def test_a_failed_graph_is_refused_with_one_line_that_gives_the_numbers() -> None:
    with pytest.raises(GateError, match=r"^action_expert: not the same model: cosine 0.5 [^;]*$"):
        require("action_expert", judge(replace(GOOD, cosine=0.5), None, GATE, TASK_GATE))


@pytest.mark.parametrize(
    ("provider", "checked"), [("CPUExecutionProvider", False), ("TensorrtExecutionProvider", True)]
)
def test_a_gate_on_another_provider_than_the_one_that_ships_is_recorded_as_such(provider: str, checked: bool) -> None:
    result = GateResult(GOOD, STEADY, Verdict("PASS"), provider, "TensorrtExecutionProvider").to_dict()
    assert result["provider"] == provider
    assert result["shipping_provider_checked"] is checked
    assert result["task"]["waypoint_cm"] == 1
    assert result["verdict"] == "PASS"


def test_a_task_result_survives_json() -> None:
    assert TaskResult.from_dict(json.loads(json.dumps(asdict(STEADY)))) == STEADY
