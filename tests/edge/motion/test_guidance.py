"""Waypoints stay where they are in the world while the robot moves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.inference.graph import GraphError
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.warm_up import warm_up
from edge.state.reasoning_text import Waypoints
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState, waypoints_now
from edge.state.switches import Speculation
from export.model.config import PRESETS
from export.model.network import build
from tests.support.artifact_directory import write_artifacts

METRES = st.floats(-50, 50)
POSES = st.builds(SE2, METRES, METRES, st.floats(-3, 3))


def world(T_odom_base: SE2, point: tuple[float, float]) -> tuple[float, float]:
    placed = T_odom_base @ SE2(*point, 0.0)
    return placed.x_m, placed.y_m


@given(anchor=POSES, now=POSES, point=st.tuples(METRES, METRES))
def test_a_waypoint_is_the_same_place_seen_from_anywhere(anchor: SE2, now: SE2, point: tuple[float, float]) -> None:
    seen = waypoints_now((point,), anchor.inverse() @ now)
    assert world(now, tuple(seen[0, 0].astype(float))) == pytest.approx(world(anchor, point), abs=1e-3)


def test_a_robot_that_has_not_moved_sees_them_unchanged() -> None:
    written = ((1.0, 0.0), (2.0, 0.5), (3.0, -1.25))
    assert np.array_equal(waypoints_now(written, SE2(0.0, 0.0, 0.0)), np.array([written], dtype=np.float32))


@pytest.fixture(scope="module")
def guided(tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    """A small policy that reads waypoints, and no motion offset beside them."""
    config = dataclasses.replace(
        PRESETS["nano"],
        action=dataclasses.replace(
            PRESETS["nano"].action, layers=2, semantic_interface="waypoints", motion_offset=False
        ),
    )
    return load_artifacts(write_artifacts(build(config, 3), tmp_path_factory.mktemp("guided")))


def state(waypoints: Waypoints | None, policy: Policy) -> SemanticState:
    kv = np.zeros((1, 5, 256), np.float32)
    return SemanticState(0, 0, SE2(0.0, 0.0, 0.0), 0, kv, policy.semantic_context(kv), "", waypoints)


def test_a_guided_policy_drives_by_the_waypoints_as_seen_from_here(guided: Artifacts) -> None:
    policy = Policy(guided, threads=1)
    tokens = policy.encode(np.full((1, 128, 128, 3), 90, np.uint8))
    offset, here = SE2(0.6, -0.3, 0.4), SE2(0.0, 0.0, 0.0)
    seen = tuple((float(x), float(y)) for x, y in waypoints_now(STRAIGHT_AHEAD, offset)[0])

    def plan(waypoints: Waypoints, moved: SE2) -> np.ndarray:
        return policy.act(tokens, (0.3, 0.0, 0.0), 2.0, moved, state(waypoints, policy))

    np.testing.assert_allclose(plan(STRAIGHT_AHEAD, offset), plan(seen, here), atol=1e-5)
    assert np.abs(plan(STRAIGHT_AHEAD, offset) - plan(STRAIGHT_AHEAD, here)).max() > 1e-4


def test_a_guided_policy_has_no_plan_without_waypoints(guided: Artifacts) -> None:
    policy = Policy(guided, threads=1)
    tokens = policy.encode(np.zeros((1, 128, 128, 3), np.uint8))
    with pytest.raises(GraphError, match="no waypoints"):
        policy.act(tokens, (0.0, 0.0, 0.0), 1.0, SE2(0.0, 0.0, 0.0), state(None, policy))


@pytest.mark.slow
def test_the_runner_warms_a_guided_policy_up(guided: Artifacts) -> None:
    warm_up(Policy(guided, threads=1), LanguageModel(guided, threads=1), Speculation.ON)
