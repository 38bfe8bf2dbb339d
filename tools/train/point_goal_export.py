"""Export a trained point-goal network as one ONNX file: `python -m tools.train.point_goal_export FILE --out bc.onnx`.

FILE is a run's `imitate/point_goal.safetensors` or `rl/point_goal.safetensors`. The ONNX file contains the encoder; it
maps frame, velocity and goal to a trajectory and is driven by `edge-bench --policy point-goal-net:`.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import onnx
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, named_file
from export.model.config import ModelConfigError, TicVlaConfig, config_from_dict
from export.model.vision import VisionEncoder
from firmware_bridge.system.terminal import CommandParser, one_line
from sim_hil.benchmark.policies.point_goal_net import FORMAT, KEY
from tools.train.config.checks import TrainError
from tools.train.imitate.trainable_policies import PointGoalNet, load_point_goal
from tools.train.run.network_file import read_network, weights_before

OPSET: Final = 20


class PointGoalModel(nn.Module):
    """Encoder and point-goal network in one module.

    Maps a frame uint8 [1, px, px, 3], state [1, 3] and goal [1, 2] m in the robot frame to a trajectory [1, steps, 3].
    """

    def __init__(self, vision: VisionEncoder, net: PointGoalNet) -> None:
        super().__init__()
        self.vision, self.net = vision, net

    def forward(self, frame: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        trajectory: Tensor = self.net(self.vision(frame), state, goal)
        return trajectory


def export(vision: VisionEncoder, net: PointGoalNet, config: TicVlaConfig, path: Path, origin: str) -> None:
    """Write the ONNX file atomically. Raises OSError."""
    px = config.vision.image_px
    frame = torch.zeros(1, px, px, 3, dtype=torch.uint8)
    inputs = (frame, torch.zeros(1, 3), torch.tensor([[1.0, 0.0]]))
    program = torch.onnx.export(
        PointGoalModel(vision, net).eval(), inputs, dynamo=True, verbose=False, opset_version=OPSET,
        input_names=["frame", "state", "goal"], output_names=["trajectory"],
    )  # fmt: skip
    if program is None:
        raise RuntimeError("torch.onnx.export returned no program")
    model = program.model_proto
    about = {"format": FORMAT, "image_px": px, "step_s": config.action.step_s, "origin": origin}
    onnx.helper.set_model_props(model, {KEY: json.dumps(about, sort_keys=True)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with named_file(path) as partial:
        onnx.save(model, str(partial))


@command_line("point_goal_export")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    p = CommandParser("point_goal_export", description=__doc__.split("\n")[0])
    p.add_argument("weights", type=Path, metavar="FILE", help="point_goal.safetensors of a run's imitate or rl stage")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.onnx", help="ONNX file to write")
    args = p.parse_args(argv)
    try:
        check_result_target(str(args.out), "--out")
        run = Path(os.path.realpath(args.weights)).parent.parent
        before = weights_before(run, "imitate")
        if before is None:
            raise TrainError(f"{run}: no encoder weights found; expected FILE inside a run folder of edge-train")
        with safe_open(str(before), framework="pt") as file:
            config = config_from_dict(json.loads((file.metadata() or {})["config"]))
        network = read_network(before, config, 0)
        net = load_point_goal(args.weights, config)
        export(network.vision, net, config, args.out, args.weights.parent.name)
    except (OSError, SafetensorError, KeyError, ModelConfigError, TrainError) as error:
        sys.stderr.write(f"point_goal_export: {one_line(error)}\n")
        return EXIT_BAD_INPUT
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
