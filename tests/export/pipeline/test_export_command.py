"""The command line of `edge-export`: what it prints, keeps and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from export.cli import main
from export.pipeline.build import build_stages, with_exceptions
from export.quantize.precision import Precision
from export.targets.file import list_targets
from tests.support.export.export_job import TARGET, job, manifest

LOOSE = [
    f"--set=gates.vision_encoder.{key}" for key in ("min_cosine=0.9", "warn_cosine=0.9", "max_abs=10")
]  # for an encoder that is rounded


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "kept"), [([], "finished stages are in the cache"), (["--no-cache"], "nothing was kept")]
)
def test_an_interrupt_names_the_remaining_parts(
    arguments: list[str], kept: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("export.cli.build_artifacts", interrupted)
    assert main(["--out", str(tmp_path / "nano"), *arguments]) == 130
    assert capsys.readouterr().err == f"edge-export: interrupted; {kept}\n"


def test_targets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list-targets"]) == 0
    assert [line.split("\t")[0] for line in capsys.readouterr().out.splitlines()] == list_targets()


@pytest.mark.slow
def test_a_dry_run_prints_the_plan_and_builds_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--target", "cpu", "--model", "1b", "--dry-run", "--json", "-"]) == 0
    captured = capsys.readouterr()
    plan = json.loads(captured.out)["plan"]
    assert {"tick_ms", "generation_ms", "average_w", "tagged"} <= set(plan)
    assert "verdict" in captured.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["--dry-run"], ["--out", "x"]])
def test_a_plan_that_does_not_fit_is_refused_before_anything_is_built(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--target", "orin", "--model", "1b", "--set", "power.mode=10W", *arguments]) == 1
    assert "1b does not fit orin (10W): tick" in capsys.readouterr().err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_precision_that_is_asked_for_ships_although_the_target_leaves_a_choice(tmp_path: Path) -> None:
    out = tmp_path / "nano"
    choice = ["--set", "graphs.vision_encoder.candidates=fp32,int8"]
    assert main(["--out", str(out), *choice, "--set", "graphs.vision_encoder.precision=int8-b32", *LOOSE]) == 0
    assert manifest(out)["graphs"]["vision_encoder"]["precision"] == {"default": "int8-b32", "overrides": {}}


@pytest.mark.parametrize(
    ("chosen", "asked", "shipped"),
    [
        ((("blocks.*", "int8"),), (("blocks.0.qkv", "fp32"),), {"blocks.0.qkv": "fp32", "blocks.*": "int8"}),
        ((("blocks.0.qkv", "int8"),), (("blocks.0.qkv", "fp32"),), {"blocks.0.qkv": "fp32"}),
        ((("blocks.0.qkv", "fp32"),), (("blocks.*", "int8"),), {"blocks.0.qkv": "fp32", "blocks.*": "int8"}),
        ((), (("blocks.*", "int4-b128"),), {}),
    ],
)
def test_the_exact_exceptions_of_a_target_win_over_what_the_search_chose(
    chosen: tuple[tuple[str, str], ...], asked: tuple[tuple[str, str], ...], shipped: dict[str, str]
) -> None:
    found = with_exceptions(Precision("int4-b128", chosen), Precision("int4-b32", asked))
    assert found == Precision("int4-b128", tuple(shipped.items()))
    assert found == Precision.from_dict(found.to_dict())


def test_weights_and_result_are_not_written_to_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = str(tmp_path / "x")
    assert main(["--out", str(tmp_path / "nano"), "--save-weights", both, "--json", both]) == 2
    refusal = f"edge-export: --json {both}: is also the file of --save-weights; name another one\n"
    assert capsys.readouterr().err == refusal
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("precision", "overrides", "expected"),
    [("fp32", {}, False), ("int8", {}, True), ("fp32", {"blocks.0.qkv": "int8"}, True)],
)
def test_a_plain_encoder_with_a_layer_in_int8_has_a_stage_for_its_ranges(
    precision: str, overrides: dict[str, str], expected: bool
) -> None:
    vision = replace(
        TARGET.graphs["vision_encoder"], form="plain", candidates=(), precision=precision, overrides=overrides
    )
    target = replace(TARGET, graphs={**TARGET.graphs, "vision_encoder": vision})
    stages = [stage.name for stage in build_stages(replace(job(), target=target), {})]
    assert ("activation ranges" in stages) == expected


@pytest.mark.slow
def test_a_setting_of_the_network_makes_that_network_and_a_small_cache_stays_small(tmp_path: Path) -> None:
    out, cache = tmp_path / "three", tmp_path / "cache"
    settings = ["--set", "model.action.layers=3", "--set", "graphs.action_expert.threads=2"]
    assert main(["--out", str(out), *settings, "--cache", str(cache), "--cache-gb", "0.03"]) == 0
    content = manifest(out)
    assert content["model"]["config"]["action"]["layers"] == 3
    assert content["graphs"]["action_expert"]["session"]["threads"] == 2
    names = [tensor["name"] for tensor in content["graphs"]["semantic_context"]["outputs"]]
    assert [name for name in names if name.endswith(".key")] == [f"context.{i}.key" for i in range(3)]
    assert 0 < sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) < 35e6
