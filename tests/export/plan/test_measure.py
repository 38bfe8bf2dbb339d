"""Times taken here become points that a target's plan uses instead of its model."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import pytest

from edge.core.cli import EXIT_BAD_INPUT
from export.core.typed import plain
from export.model.config import PRESETS
from export.plan.measure import main, measure_points, points_toml
from export.plan.plan import plan
from export.targets.file import Target, load_target, parse_target
from export.targets.sections import MEASURED, Measured


@pytest.fixture(scope="module")
def points(artifacts_dir: Path) -> list[Measured]:
    return measure_points(artifacts_dir, machine="this machine", date="2026-11-21", repeats=3)


def with_points(points: list[Measured]) -> Target:
    return dataclasses.replace(load_target("cpu", "nano"), measured=tuple(points))


@pytest.mark.slow
def test_a_plan_with_these_points_is_measured_throughout(points: list[Measured]) -> None:
    made = plan(with_points(points), PRESETS["nano"])
    assert {stage.whole.tag for stage in made.stages} == {MEASURED}
    assert all("this machine, 2026-11-21" in stage.whole.source for stage in made.stages)


@pytest.mark.slow
def test_what_is_printed_can_be_appended_to_a_target_file(points: list[Measured]) -> None:
    point = dataclasses.replace(points[0], overrides={"blocks.*.fc1": "int8"}, machine='a "quoted" name')
    tables = tomllib.loads(points_toml([point, *points[1:]]))
    content = {**load_target("cpu").to_dict(), **tables}
    assert parse_target(content, "x").measured == (point, *points[1:])
    assert plain(point)["overrides"] == {"blocks.*.fc1": "int8"}


def test_a_directory_that_is_not_one_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none")]) == EXIT_BAD_INPUT
    assert "not a directory" in capsys.readouterr().err
