"""The chain of poses: motion between two of its nodes, and how uncertain it is, wherever the chain began."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.odometry import pose_chain
from edge.odometry.gate import Increment
from edge.odometry.pose_chain import HEADING, PARAMETERS, SCALE, SIDEWAYS, Node, OdometryModel, integrate

NONE = np.zeros((PARAMETERS, PARAMETERS))
STEP_NS = 10_000_000
starts = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))


def arc(start: tuple[float, float, float], parameters: np.ndarray, steps: int = 100) -> list[Node]:
    """2 m on a curve, with 4 mm and 0.02 rad of white noise a metre or so and a bias by time."""
    nodes = [pose_chain.origin(0, start, parameters)]
    for index in range(steps):
        nodes.append(pose_chain.extend(nodes[-1], (index + 1) * STEP_NS, 0.02, 0.0, 0.01, 1.6e-7, 4e-6, 0.02))
    return nodes


@given(starts)
def test_the_uncertainty_of_a_motion_does_not_depend_on_where_the_chain_began(
    start: tuple[float, float, float],
) -> None:
    parameters = np.diag((1e-4, 1e-4, 1e-4, 1e-4))
    here, there = (
        pose_chain.relative(nodes[20], nodes[90]) for nodes in (arc((0, 0, 0), parameters), arc(start, parameters))
    )
    assert here[0].as_tuple() == pytest.approx(there[0].as_tuple(), abs=1e-9)
    assert np.allclose(here[1], there[1], rtol=1e-4, atol=1e-10)


def test_no_motion_has_no_uncertainty() -> None:
    node = arc((1.0, 2.0, 0.5), NONE)[50]
    motion, covariance = pose_chain.relative(node, node)
    assert motion.as_tuple() == pytest.approx((0, 0, 0))
    assert np.abs(covariance).max() < 1e-12


def test_white_noise_spreads_as_in_two_thousand_drives() -> None:
    rng = np.random.default_rng(0)
    _, said = pose_chain.relative(*[arc((5.0, -3.0, 1.0), NONE)[i] for i in (0, 100)])
    x = y = theta = np.zeros(2000)
    for _ in range(100):
        ahead, left = rng.normal(0.02, math.sqrt(1.6e-7), 2000), rng.normal(0, math.sqrt(1.6e-7), 2000)
        turn = rng.normal(0.01, math.sqrt(4e-6), 2000)
        c, s = np.cos(theta + turn / 2), np.sin(theta + turn / 2)
        x, y, theta = x + c * ahead - s * left, y + s * ahead + c * left, theta + turn
    found = np.cov(np.stack((x, y, theta)))
    assert np.sqrt(np.diag(said)) == pytest.approx(np.sqrt(np.diag(found)), rel=0.1)
    correlation = said[1, 2] / math.sqrt(said[1, 1] * said[2, 2])
    assert correlation == pytest.approx(found[1, 2] / math.sqrt(found[1, 1] * found[2, 2]), abs=0.1)


@pytest.mark.parametrize(("which", "sigma"), [(HEADING, 0.05), (SCALE, 0.02)])
def test_a_bias_spreads_as_the_motion_with_it_does(which: int, sigma: float) -> None:
    parameters = np.zeros((PARAMETERS, PARAMETERS))
    parameters[which, which] = sigma**2
    with_bias, without = (
        pose_chain.relative(*[arc((2.0, 1.0, -1.0), p)[i] for i in (0, 100)])[1] for p in (parameters, NONE)
    )
    pose = SE2(0.0, 0.0, 0.0)
    for _ in range(100):
        turn = 0.01 - (sigma * 0.02 if which == HEADING else 0.0)
        length = 0.02 * (1 - (sigma if which == SCALE else 0.0))
        pose = pose @ SE2(0.0, 0.0, turn / 2) @ SE2(length, 0.0, 0.0) @ SE2(0.0, 0.0, turn / 2)
    nominal = pose_chain.relative(*[arc((0, 0, 0), NONE)[i] for i in (0, 100)])[0]
    error = np.array((pose.x_m - nominal.x_m, pose.y_m - nominal.y_m, pose.theta_rad - nominal.theta_rad))
    assert with_bias - without == pytest.approx(np.outer(error, error), rel=0.1, abs=2e-6)


def test_an_interval_counts_like_the_increments_that_it_is_made_of() -> None:
    small = arc((4.0, 4.0, 2.0), NONE)
    motion, covariance = pose_chain.relative(small[0], small[100])
    whole = pose_chain.add_interval(
        small[0], small[100].stamp_ns, np.array(motion.as_tuple()), covariance, np.zeros((3, PARAMETERS)), NONE
    )
    assert whole.pose.as_tuple() == pytest.approx(small[100].pose.as_tuple())
    assert whole.white == pytest.approx(small[100].white, abs=1e-12)


@given(*(st.floats(-0.1, 0.1) for _ in range(2)), st.floats(0.9, 1.1), st.floats(0.7, 1.4), st.floats(-0.3, 0.3))
def test_a_report_made_as_the_calibration_says_is_undone(
    x: float, y: float, scale_x: float, scale_y: float, sideways: float
) -> None:
    """Reported are the scaled motions, and to the left also `sideways` per metre forward."""
    model = OdometryModel(True, 0.0, scale_x - 1, sideways, scale_y, 1.0, 0.0, 0.0, 0.0, 0.0)
    reported = Increment(STEP_NS, 0.01, scale_x * x, scale_y * y + sideways * x, 0.0, 0.0)
    assert model.corrected(reported)[:2] == pytest.approx((x, y), abs=1e-12)


@pytest.mark.parametrize("which", [HEADING, SCALE, SIDEWAYS])
def test_the_derivatives_of_an_interval_are_those_of_its_motion(which: int) -> None:
    """`gains` is the error that the parameter's error causes, so the motion's derivative with its sign changed."""
    name, step = {HEADING: "heading", SCALE: "scale", SIDEWAYS: "sideways"}[which], 1e-6
    model = OdometryModel(True, 0.02, 0.0, 0.0, 1.3, 1.0, 0.0, 0.0, 0.0, 0.0)
    increments = [Increment((n + 1) * STEP_NS, 0.01, 0.008, 0.001, 0.004, 0.004) for n in range(100)]
    before, after = (
        integrate(increments, replace(model, **{name: getattr(model, name) + sign * step})).motion for sign in (-1, 1)
    )
    assert integrate(increments, model).gains[:, which] == pytest.approx(-(after - before) / (2 * step), rel=0.02)


def test_before_its_beginning_the_chain_knows_nothing() -> None:
    assert pose_chain.at(arc((0.0, 0.0, 0.0), NONE), -1) is None
    assert pose_chain.at([], 0) is None
