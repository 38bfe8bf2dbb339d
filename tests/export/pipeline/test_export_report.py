"""report.html: everything that report.json says, on one page that loads nothing."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from export.pipeline.report import precision_text, report_html, size_text
from tests.support.html_page import HtmlPage, assert_loads_nothing


@pytest.fixture(scope="module")
def report(artifacts_dir: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((artifacts_dir / "report.json").read_text())
    return content


@pytest.fixture
def changed(report: dict[str, Any]) -> dict[str, Any]:
    return copy.deepcopy(report)


def text_of(report: dict[str, Any]) -> str:
    return " ".join(" ".join(HtmlPage(report_html(report)).pieces).split())


@pytest.mark.slow
def test_the_page_is_made_of_report_json_alone(artifacts_dir: Path, report: dict[str, Any]) -> None:
    assert report_html(report) == (artifacts_dir / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_loads_nothing(report: dict[str, Any]) -> None:
    assert_loads_nothing(report_html(report))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vision_encoder", "language_model", "semantic_context", "action_expert"])
def test_every_graph_has_its_size_exactness_verdict_and_reason(report: dict[str, Any], name: str) -> None:
    graph, text = report["graphs"][name], text_of(report)
    assert size_text(graph["bytes"]) in text
    assert f"{graph['parity']['cosine']:.6f}" in text
    assert f"{name}: fp32" in text
    assert graph["precision_reason"] in text
    assert text.count("PASS") == 4


@pytest.mark.slow
def test_plan_calibration_and_provenance_are_on_the_page(report: dict[str, Any]) -> None:
    text = text_of(report)
    assert f"{report['plan']['tick_ms']:,.4g} ms" in text
    assert report["plan"]["tagged"] in text
    assert report["provenance"]["calibration"]["name"] in text
    assert report["provenance"]["weights_sha256"] in text
    assert f"onnxruntime {report['provenance']['packages']['onnxruntime']}" in text


@pytest.mark.slow
def test_graphs_come_in_the_order_in_which_they_run(report: dict[str, Any]) -> None:
    text = text_of(report)
    places = [text.index(name) for name in ("vision_encoder", "language_model", "semantic_context", "action_expert")]
    assert places == sorted(places)


@pytest.mark.slow
def test_untrained_weights_are_marked_and_trained_ones_are_not(changed: dict[str, Any]) -> None:
    assert "The weights are untrained" in report_html(changed)
    changed["model"]["trained"] = True
    assert "untrained" not in report_html(changed)


@pytest.mark.slow
def test_a_graph_checked_on_another_provider_is_marked(changed: dict[str, Any]) -> None:
    assert "repeat this check" not in report_html(changed)
    changed["graphs"]["vision_encoder"]["session"]["provider"] = "TensorrtExecutionProvider"
    changed["graphs"]["vision_encoder"]["parity"]["shipping_provider_checked"] = False
    text = text_of(changed)
    assert "The device still has to repeat this check." in text
    assert "made for TensorrtExecutionProvider" in text
    assert "edge-export verify DIR" in text


@pytest.mark.slow
def test_a_warning_is_shown_with_its_reason(changed: dict[str, Any]) -> None:
    changed["graphs"]["action_expert"]["parity"] |= {"verdict": "WARN", "reasons": ["cosine 0.995 (≥ 0.999)"]}
    text = text_of(changed)
    assert "4 graphs pass, 1 with a warning" in text
    assert "action_expert : cosine 0.995 (≥ 0.999)" in text


@pytest.mark.slow
def test_a_plan_that_does_not_fit_gives_the_reason(changed: dict[str, Any]) -> None:
    changed["plan"] |= {"fits": False, "reasons": ["tick 250 ms exceeds the period of 100 ms"], "generation_ms": None}
    text = text_of(changed)
    assert "Does not fit: tick 250 ms exceeds the period of 100 ms" in text


@pytest.mark.slow
def test_the_halves_of_a_language_model_share_its_thresholds(changed: dict[str, Any]) -> None:
    whole = changed["graphs"].pop("language_model")
    changed["graphs"] |= {f"language_model.{half}": whole for half in ("prefill", "decode")}
    text = text_of(changed)
    assert text.index("language_model.prefill") < text.index("language_model.decode")


@pytest.mark.slow
def test_layers_that_were_searched_are_plotted(changed: dict[str, Any]) -> None:
    row = {"precision": "int8", "waypoint_cm": 0.3}
    changed["sensitivity"]["vision_encoder"] = {
        "precision": {"default": "int8", "overrides": {"blocks.1.*": "fp32"}},
        "table": [{**row, "group": "*"}, {**row, "group": "blocks.1.*"}, {**row, "group": "projector.*"}],
    }
    changed["sensitivity"]["vision_encoder"]["table"][1]["waypoint_cm"] = 0.0  # has no logarithm
    page = HtmlPage(report_html(changed))
    text = " ".join(" ".join(page.pieces).split())
    assert sum(tag == "img" for tag, _ in page.tags) == 2
    assert (
        "the 2 most sensitive groups of layers, each rounded alone to int8, filled: raised to a more exact precision"
        in text
    )


@pytest.mark.slow
def test_text_from_files_cannot_act_on_the_page(changed: dict[str, Any]) -> None:
    evil = "<script>alert(1)</script>\u202e"
    changed["provenance"]["weights_origin"] = evil
    changed["provenance"]["calibration"]["name"] = evil
    changed["graphs"]["vision_encoder"]["precision_reason"] = evil
    changed["model"]["name"] = evil
    changed["graphs"]["vision_encoder"]["session"]["provider"] = evil
    page = report_html(changed)
    assert "<script" not in page
    assert "\u202e" not in page


@pytest.mark.parametrize(("count", "shown"), [(1.234e9, "1.23 GB"), (48e6, "48 MB"), (2500, "2.5 kB"), (12, "12 B")])
def test_sizes_are_in_the_unit_that_fits(count: float, shown: str) -> None:
    assert size_text(count) == shown


def test_exceptions_to_a_precision_are_counted() -> None:
    assert precision_text({"default": "int8", "overrides": {}}) == "int8"
    assert precision_text({"default": "int8", "overrides": {"a": "fp32"}}) == "int8 + 1 exception"
    assert precision_text({"default": "int8", "overrides": {"a": "fp32", "b": "fp32"}}) == "int8 + 2 exceptions"
