"""A learned point-goal policy: the file says what it is, the benchmark drives it within the runner's limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from edge.core.geometry import SE2
from export.model.network import build
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.point_goal_net import PointGoalNetPolicy
from sim_hil.benchmark.policies.select import robot_config
from tests.support.benchmark.benchmark_episodes import corridor_episode
from tests.support.train.train_drives import tiny_model
from tools.train.imitate.trainable_policies import build_point_goal
from tools.train.point_goal_export import PointGoalModel, export


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config, path = tiny_model(), tmp_path_factory.mktemp("point-goal") / "net.onnx"
    net = build_point_goal(config, torch.Generator().manual_seed(1))
    export(build(config, 0).vision, net, config, path, "test")
    return path


def _seen(x_m: float = 0.0) -> Observation:
    image = np.random.default_rng(3).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    return Observation(0.0, image, (0.1, 0.0, 0.2), SE2(x_m, 0.0, 0.0), False, False)


@pytest.mark.slow
def test_the_graph_is_the_network(file: Path) -> None:
    config = tiny_model()
    net = build_point_goal(config, torch.Generator().manual_seed(1)).eval()
    seen = _seen()
    with torch.no_grad():
        whole = PointGoalModel(build(config, 0).vision.eval(), net)
        wanted = whole(torch.from_numpy(seen.image)[None], torch.tensor([seen.state]), torch.tensor([[3.0, 1.0]]))
    feeds = {
        "frame": seen.image[None],
        "state": np.array([seen.state], np.float32),
        "goal": np.array([[3.0, 1.0]], np.float32),
    }
    (found,) = ort.InferenceSession(str(file)).run(None, feeds)
    assert np.allclose(found, wanted.numpy(), atol=1e-4)


@pytest.mark.slow
def test_the_goal_is_given_in_the_robot_frame(file: Path) -> None:
    policy, episode = PointGoalNetPolicy(file, robot_config()), corridor_episode()
    policy.reset(episode, "not read", None, 0)
    start = SE2(*episode.start)
    policy.act(_seen(1.0))
    goal = SE2(1.0, 0.0, 0.0).inverse() @ start.inverse() @ SE2(*episode.goal_xy, 0.0)
    assert policy.notes()["waypoints"] == [[goal.x_m, goal.y_m]]


@pytest.mark.slow
def test_its_commands_are_within_the_robots_limits(file: Path) -> None:
    policy, limits = PointGoalNetPolicy(file, robot_config()), robot_config().limits
    policy.reset(corridor_episode(), "", None, 0)
    for _ in range(5):
        vx, vy, wz = policy.act(_seen())
        assert 0.0 <= vx <= limits.vx_max_mps and vy == 0.0 and abs(wz) <= limits.wz_max_radps


@pytest.mark.slow
def test_another_onnx_file_is_refused(file: Path, tmp_path: Path) -> None:
    model = onnx.load(str(file))
    del model.metadata_props[:]
    other = tmp_path / "other.onnx"
    onnx.save(model, str(other))
    with pytest.raises(ConditionsError, match="expected a file of format"):
        PointGoalNetPolicy(other, robot_config())


def test_a_file_that_is_not_onnx_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    path.write_bytes(b"no")
    with pytest.raises(ConditionsError, match="expected a readable ONNX file"):
        PointGoalNetPolicy(path, robot_config())


def test_it_runs_no_generation() -> None:
    from sim_hil.benchmark.conditions.latency import LatencyProfile

    with pytest.raises(ConditionsError, match="latency: expected only with"):
        Conditions(PolicySpec("point-goal-net", "net.onnx"), latency=LatencyProfile.constant(1.0))
