"""One control tick (encoder + action expert) on one core: the exported graphs, paired with PyTorch in the same run.

    python -m tools.bench.tick --artifacts out/demo/artifacts --json out/bench/tick.json

Prints medians and the ratio; the JSON has every sample. The two alternate, so that a slower machine affects both.
`--core` pins the process to one core.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from edge.artifacts.files import ArtifactError, read_manifest
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import EXIT_DONE, command_line, write_result
from edge.core.geometry import SE2
from edge.inference.policy import Policy
from edge.state.semantic import SemanticState
from export.model.config import config_for
from export.model.network import build
from tools.bench import bad_input, command_parser

HERE = SE2(0.0, 0.0, 0.0)


def onnx_tick(directory: Path, image: NDArray[np.uint8], kv: NDArray[np.float32]) -> Callable[[], NDArray[np.float32]]:
    """Return the tick of the runner's code."""
    policy = Policy(load_artifacts(directory), threads=1)
    semantic = SemanticState(0, 0, HERE, 0, kv, policy.semantic_context(kv), "", None)
    return lambda: policy.act(policy.encode(image), (0.4, 0.0, 0.0), 2.0, HERE, semantic)


def torch_tick(model_name: str, image: NDArray[np.uint8], kv: NDArray[np.float32]) -> Callable[[], NDArray[np.float32]]:
    """Return the tick of the same network in eager PyTorch on one thread."""
    torch.set_num_threads(1)
    model = build(config_for(model_name), 0)
    frame, state, latency = torch.from_numpy(image), torch.tensor([[0.4, 0.0, 0.0]]), torch.tensor([[2.0, 0, 0, 0]])
    with torch.no_grad():
        keys, values = model.action.context(torch.from_numpy(kv))

    def tick() -> NDArray[np.float32]:
        with torch.no_grad():
            plan: torch.Tensor = model.action(model.vision(frame), state, latency, keys, values)
            found: NDArray[np.float32] = plan.numpy()
            return found

    return tick


@command_line("tick")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--rounds", type=int, default=100)
    p.add_argument("--tokens", type=int, default=200, help="tokens of the semantic state (default: 200)")
    p.add_argument("--core", type=int, default=0, help="processor to pin to (default: 0)")
    args = p.parse_args(argv)
    rng = np.random.default_rng(0)
    try:
        if args.rounds < 1 or not 1 <= args.tokens <= 100_000:
            raise ArtifactError("--rounds and --tokens must be positive")
        os.sched_setaffinity(0, {args.core})
        artifacts = load_artifacts(args.artifacts)
        model_name = read_manifest(args.artifacts)["model"]["name"]
        if args.tokens > artifacts.runtime.max_context:
            raise ArtifactError(f"--tokens {args.tokens}: the model reads {artifacts.runtime.max_context}")
    except (ArtifactError, OSError) as error:
        return bad_input("tick", error)
    px = artifacts.runtime.image_px
    image = rng.integers(0, 256, (1, px, px, 3)).astype(np.uint8)
    kv = rng.standard_normal((1, args.tokens, artifacts.runtime.kv_dim)).astype(np.float32)
    ticks = {"onnxruntime": onnx_tick(args.artifacts, image, kv), "torch": torch_tick(model_name, image, kv)}
    samples: dict[str, list[float]] = {name: [] for name in ticks}
    for round_index in range(-5, args.rounds):
        for name, tick in ticks.items():
            started_ns = time.monotonic_ns()
            tick()
            if round_index >= 0:
                samples[name].append((time.monotonic_ns() - started_ns) / 1e6)
    medians = {name: statistics.median(values) for name, values in samples.items()}
    ratio = statistics.median(t / o for o, t in zip(samples["onnxruntime"], samples["torch"], strict=True))
    result = {"tick_ms_median": medians, "torch_over_onnxruntime": ratio, "samples_ms": samples, "tagged": "measured"}
    write_result(args.json, result)
    if args.json != "-":
        print(f"one core, {args.rounds} rounds, medians: " + ", ".join(f"{n} {m:.1f} ms" for n, m in medians.items()))
        print(f"PyTorch takes {ratio:.2f} times as long (median of the pairs)")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
