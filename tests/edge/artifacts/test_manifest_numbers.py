"""Numbers of a manifest that no device and no policy can have, and data files that no graph names, are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from tests.support.artifact_directory import edit_manifest

Edit = Callable[[dict[str, Any]], object]
GIB = 1 << 30


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def with_delay(planned_s: object, asked_s: object) -> Edit:
    """The largest age of a semantic state in the plan, and in the target that the plan was made for."""

    def edit(manifest: dict[str, Any]) -> None:
        manifest["plan"]["max_delay_s"] = planned_s
        manifest["provenance"]["target"]["runtime"]["max_delay_s"] = asked_s

    return edit


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.1, 10, 60.0])
def test_a_semantic_state_may_become_a_minute_old(copy: Path, delay_s: float) -> None:
    edit_manifest(copy, with_delay(delay_s, delay_s))
    load_artifacts(copy)


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0, -1, 0.05, 60.5, 600, 1e6, True, "10"])
def test_an_age_of_a_semantic_state_at_which_no_robot_may_drive_is_refused(copy: Path, delay_s: object) -> None:
    edit_manifest(copy, with_delay(delay_s, delay_s))
    with pytest.raises(ArtifactError, match=f"max_delay_s {delay_s!r}, expected 0.1 to 60"):
        load_artifacts(copy)


def test_a_plan_for_another_age_than_the_target_asks_for_is_refused(copy: Path) -> None:
    edit_manifest(copy, with_delay(30.0, 10.0))
    with pytest.raises(ArtifactError, match=r"max_delay_s is 30\.0, the target's is 10\.0"):
        load_artifacts(copy)


@pytest.mark.parametrize("budget_w", [-5, 0, 1001, "25"])
def test_a_power_budget_that_no_device_has_is_refused(copy: Path, budget_w: object) -> None:
    edit_manifest(copy, lambda m: m["provenance"]["target"]["power"].update(budget_w=budget_w))
    with pytest.raises(ArtifactError, match=f"budget_w {budget_w!r}, expected 0.1 to 1000"):
        load_artifacts(copy)


@pytest.mark.slow
def test_a_manifest_without_a_plan_and_a_target_is_taken(copy: Path) -> None:
    edit_manifest(copy, lambda m: m.update(plan={}, provenance={}))
    load_artifacts(copy)


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m["plan"].update(max_delay_s=10**400),
        lambda m: m["provenance"]["target"]["device"].update(memory_gib=10**400),
        lambda m: m["self_test"].update(seed=-(10**400)),
    ],
)
def test_an_integer_of_hundreds_of_digits_is_refused_before_it_is_used(copy: Path, change: Edit) -> None:
    edit_manifest(copy, change)
    with pytest.raises(ArtifactError, match=r"manifest\.json: an integer of 1329 bits"):
        load_artifacts(copy)


def test_frames_that_begin_in_the_past_are_refused(copy: Path) -> None:
    edit_manifest(copy, lambda m: m["runtime"].update(frame_offsets_s=[3.0, 6.0]))
    with pytest.raises(ArtifactError, match="must begin with 0, the newest frame"):
        load_artifacts(copy)


def test_a_data_file_that_no_graph_names_is_refused_without_reading_it(copy: Path) -> None:
    entry = {"bytes": 60 * GIB, "sha256": "0" * 64}
    edit_manifest(copy, lambda m: m["files"].update({"spare.onnx.data": entry}))
    with pytest.raises(ArtifactError, match=r"spare\.onnx\.data is listed, but no graph names it"):
        load_artifacts(copy)


def test_data_files_have_a_limit_together(copy: Path) -> None:
    def edit(manifest: dict[str, Any]) -> None:
        for name in ("a.onnx.data", "b.onnx.data"):
            manifest["files"][name] = {"bytes": 40 * GIB, "sha256": "0" * 64}
            manifest["graphs"]["vision_encoder"]["data_files"].append(name)

    edit_manifest(copy, edit)
    with pytest.raises(ArtifactError, match=f"data files of {80 * GIB} bytes together, expected at most {64 * GIB}"):
        load_artifacts(copy)
