"""One control tick (encoder + action expert) on one core: the exported graphs, paired with PyTorch in the same run.

    python -m tools.bench.tick --artifacts out/demo/artifacts --json out/bench/tick.json
    python -m tools.bench.tick --artifacts out/1b --parts action --tokens 1132

Prints medians of each part and of their sum, and the ratios, by time and by the process's CPU time, which also
compares on a busy machine; the JSON has every sample. The two alternate, so that a slower machine affects both.
`--core` pins the process to one core.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edge.artifacts.files import ArtifactError, read_manifest
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.inference.policy import Policy
from edge.state.semantic import SemanticState
from export.model.config import config_for
from export.model.network import build
from tools.bench import bad_input, command_parser

HERE = SE2(0.0, 0.0, 0.0)
PARTS = ("encoder", "action")
WARM_ROUNDS = 3


Part = Callable[[], object]


def onnx_parts(directory: Path, image: NDArray[np.uint8], kv: NDArray[np.float32]) -> dict[str, Part]:
    """Return the two calls of the runner's code."""
    policy = Policy(load_artifacts(directory), threads=1)
    semantic = SemanticState(0, 0, HERE, 0, kv, policy.semantic_context(kv), "", None)
    tokens = policy.encode(image)
    return {
        "encoder": lambda: policy.encode(image, tokens),
        "action": lambda: policy.act(tokens, (0.4, 0.0, 0.0), 2.0, HERE, semantic),
    }


def torch_parts(model_name: str, image: NDArray[np.uint8], kv: NDArray[np.float32]) -> dict[str, Part]:
    """Return the same calls of the same network in eager PyTorch on one thread."""
    torch.set_num_threads(1)
    model = build(config_for(model_name), 0)
    frame, state, latency = torch.from_numpy(image), torch.tensor([[0.4, 0.0, 0.0]]), torch.tensor([[2.0, 0, 0, 0]])
    with torch.no_grad():
        keys, values = model.action.context(torch.from_numpy(kv))
        tokens = model.vision(frame)

    def run(work: Callable[[], torch.Tensor]) -> Part:
        def part() -> None:
            with torch.no_grad():
                work().numpy()

        return part

    return {
        "encoder": run(lambda: model.vision(frame)),
        "action": run(lambda: model.action(tokens, state, latency, keys, values)),
    }


def measure(
    contenders: Mapping[str, Mapping[str, Part]], parts: Sequence[str], rounds: int
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return contender → part → `wall_ms` and `cpu_ms` → one sample per round; the first rounds are left out."""
    samples: dict[str, dict[str, dict[str, list[float]]]] = {
        name: {part: {"wall_ms": [], "cpu_ms": []} for part in parts} for name in contenders
    }
    for round_index in range(-WARM_ROUNDS, rounds):
        for name, calls in contenders.items():
            for part in parts:
                wall_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
                calls[part]()
                if round_index >= 0:
                    samples[name][part]["cpu_ms"].append((time.process_time_ns() - cpu_ns) / 1e6)
                    samples[name][part]["wall_ms"].append((time.monotonic_ns() - wall_ns) / 1e6)
    for of_parts in samples.values():
        if len(parts) > 1:
            of_parts["tick"] = {
                unit: [sum(values) for values in zip(*(of_parts[part][unit] for part in parts), strict=True)]
                for unit in ("wall_ms", "cpu_ms")
            }
    return samples


@command_line("tick")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--rounds", type=int, default=100)
    p.add_argument("--tokens", type=int, default=200, help="tokens of the semantic state (default: 200)")
    p.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="(default: both)")
    p.add_argument("--core", type=int, default=0, help="processor to pin to (default: 0)")
    args = p.parse_args(argv)
    rng = np.random.default_rng(0)
    try:
        check_result_target(args.json)
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
    contenders = {"onnxruntime": onnx_parts(args.artifacts, image, kv), "torch": torch_parts(model_name, image, kv)}
    samples = measure(contenders, args.parts, args.rounds)
    result: dict[str, Any] = {"parts": {}, "samples": samples, "tagged": "measured"}
    for part in samples["torch"]:
        ours, theirs = samples["onnxruntime"][part], samples["torch"][part]
        result["parts"][part] = {
            unit: {
                "onnxruntime": statistics.median(ours[unit]),
                "torch": statistics.median(theirs[unit]),
                "torch_over_onnxruntime": statistics.median(
                    t / o for o, t in zip(ours[unit], theirs[unit], strict=True)
                ),
            }
            for unit in ours
        }
    write_result(args.json, result)
    if args.json != "-":
        print(f"one core, {args.rounds} rounds, medians; ratio: PyTorch over ONNX Runtime, median of the pairs")
        for part, units in result["parts"].items():
            for unit, row in units.items():
                figures = f"{row['onnxruntime']:.2f} ms, PyTorch {row['torch']:.2f} ms"
                print(f"{part:8s} {unit:8s} {figures}, ratio {row['torch_over_onnxruntime']:.2f}")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
