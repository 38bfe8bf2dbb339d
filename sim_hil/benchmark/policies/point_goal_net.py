"""Learned point-goal baseline (paper Table 1, BC and RL); inputs: image, velocity, goal position.

The policy is one ONNX file with its format in the metadata. The runner's own controller and limits follow the plan.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import onnxruntime as ort

from edge.core.geometry import SE2
from edge.motion.controller import Controller, ControllerConfig, ControllerInputs
from edge.state.frame import fit_frame
from firmware_bridge.core.config import RobotConfig
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.policy import Velocity
from sim_hil.benchmark.suite.episode import Episode

if TYPE_CHECKING:
    from sim_hil.benchmark.env.world import EpisodeWorld

FORMAT: Final = "tic-vla-edge-point-goal/1"
KEY: Final = "point_goal"
_AGE_MS: Final = 1000.0  # age limit of frame and odometry; never reached in virtual time


class PointGoalNetPolicy:
    """Policy from an ONNX file. Raises ConditionsError if the file is not a point-goal network."""

    privileged = False
    needs_image = True

    def __init__(self, path: Path, robot: RobotConfig) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            about = json.loads(self._session.get_modelmeta().custom_metadata_map.get(KEY, "{}"))
        except Exception as error:  # ONNX Runtime raises types of its own for every kind of bad file
            raise ConditionsError(f"policy point-goal-net:{path}: expected a readable ONNX file ({error})") from error
        if about.get("format") != FORMAT:
            raise ConditionsError(
                f"policy point-goal-net:{path}: expected a file of format {FORMAT}, found {about.get('format')}"
            )
        self._px, step_s = int(about["image_px"]), float(about["step_s"])
        self._config = ControllerConfig(robot.limits, step_s, _AGE_MS, _AGE_MS)
        self._controller = Controller(self._config)
        self._goal = SE2(0.0, 0.0, 0.0)
        self._ahead: tuple[float, float] = (0.0, 0.0)
        self.name = f"point-goal-net:{about.get('origin', path.name)}"

    @property
    def camera(self) -> tuple[int, int]:
        """Input image size (width, height), px."""
        return (self._px, self._px)

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Compute the goal relative to the start, where odometry begins; the instruction is ignored."""
        self._goal = SE2(*episode.start).inverse() @ SE2(*episode.goal_xy, 0.0)
        self._controller = Controller(self._config)

    def act(self, observation: Observation) -> Velocity:
        """Return the command of one control period. Raises ValueError without an image."""
        if observation.image is None:
            raise ValueError("point-goal-net: expected an image in every observation")
        goal = observation.T_odom_base.inverse() @ self._goal
        self._ahead = (goal.x_m, goal.y_m)
        feeds = {
            "frame": fit_frame(observation.image, self._px),
            "state": np.array([observation.state], dtype=np.float32),
            "goal": np.array([self._ahead], dtype=np.float32),
        }
        (trajectory,) = self._session.run(["trajectory"], feeds)
        inputs = ControllerInputs(trajectory[0], frame_age_ms=0.0, odometry_age_ms=0.0)
        command = self._controller.step(inputs, round(observation.time_s * 1e9))
        return (command.vx_mps, command.vy_mps, command.wz_radps)

    def notes(self) -> Mapping[str, object]:
        """Return `waypoints`: the goal in the base frame, m."""
        return {"waypoints": [list(self._ahead)]}

    def close(self) -> None:
        """Nothing to release."""
