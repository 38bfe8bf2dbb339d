"""`python -m export.plan.measure DIR`: time every stage of an artifact directory here, as a target's `[[measured]]`.

The stages run through the runner's own classes, one at a time, on random frames. The points go into the target's TOML,
where they replace the modelled times of exactly this model, precision, form and provider.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge.artifacts.files import ArtifactError, read_manifest
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.device import read_device
from edge.core.geometry import SE2
from edge.inference.language import Generation, LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_WAY
from edge.state.ring import EncodedFrame
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState
from export.core.typed import plain
from export.plan.timing import stage_graph
from export.quantize.precision import Precision
from export.targets.file import Target, parse_target
from export.targets.sections import Measured, TargetError

INSTRUCTION = "walk down the corridor and stop at the vending machine"
STAGES = ("vision_encoder", "action_expert", "prefill", "decode", "semantic_context")


def measure_points(directory: Path, *, machine: str, date: str, repeats: int = 7) -> list[Measured]:
    """Median times of every stage on this machine; raises ArtifactError, TargetError for a target it cannot read."""
    artifacts = load_artifacts(directory)
    manifest = read_manifest(directory)
    target = parse_target(manifest["provenance"]["target"], f"{directory.name}: the target in its manifest")
    samples = _samples(artifacts, repeats)
    return [
        measured_point(target, manifest, artifacts, stage, samples, machine=machine, date=date)
        for stage in STAGES
        if samples[stage]
    ]


def _samples(artifacts: Artifacts, repeats: int) -> dict[str, Any]:
    """Times in ms by stage (decode: per token), and the lengths that they were taken at."""
    runtime = artifacts.runtime
    policy, language = Policy(artifacts), LanguageModel(artifacts)
    rng, here = np.random.default_rng(0), SE2(0.0, 0.0, 0.0)
    image = rng.integers(0, 256, (1, runtime.image_px, runtime.image_px, 3)).astype(np.uint8)
    frames = [EncodedFrame(i, here, policy.encode(image)) for i in range(len(runtime.frame_offsets_s))]
    segments = language.prompt.build(frames, INSTRUCTION, EXAMPLE_WAY, EXAMPLE_BEFORE)

    def generate() -> Generation:
        return language.generate(segments, max_new_tokens=runtime.max_new_tokens, cancelled=lambda: False)

    generation = generate()
    context = policy.semantic_context(generation.last_layer_kv)
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, context, generation.text, STRAIGHT_AHEAD)
    generations = [generate() for _ in range(max(3, repeats // 2))]
    return {
        "vision_encoder": _timed(lambda: policy.encode(image), repeats),
        "action_expert": _timed(
            lambda: policy.act(frames[0].tokens, (0.0, 0.0, 0.0), 1.0, here, semantic), max(repeats, 20)
        ),
        "prefill": [g.prefill_ms for g in generations],
        "decode": [g.decode_ms / g.new_tokens for g in generations if g.new_tokens],
        "semantic_context": _timed(lambda: policy.semantic_context(generation.last_layer_kv), repeats),
        "prompt": generation.prompt_tokens,
        "new": generation.new_tokens,
    }


def _timed(call: Callable[[], object], repeats: int) -> list[float]:
    call()  # the first call allocates
    times_ms: list[float] = []
    for _ in range(repeats):
        started_ns = time.monotonic_ns()
        call()
        times_ms.append((time.monotonic_ns() - started_ns) / 1e6)
    return times_ms


def measured_point(
    target: Target,
    manifest: Mapping[str, Any],
    artifacts: Artifacts,
    stage: str,
    samples: Mapping[str, Any],
    *,
    machine: str,
    date: str,
    energy_j: float | None = None,
) -> Measured:
    """The point of one stage: `samples` has its times in ms (decode: of a token), and `prompt` and `new` tokens.

    `energy_j` is the energy above idle of one such time. Raises TargetError for a time that is no time.
    """
    graph = stage_graph(target, stage)
    policy, times_ms = target.graphs[graph], samples[stage]
    precision = Precision.from_dict(manifest["graphs"][graph]["precision"])
    median_ms = statistics.median(times_ms)
    context = samples["prompt"] + samples["new"]
    tokens = {"prefill": samples["prompt"], "decode": samples["prompt"] + samples["new"] // 2}.get(stage, context)
    threads = artifacts.graphs[graph].session.threads or 1
    return Measured(
        model=artifacts.model_name,
        graph=graph,
        precision=precision.default,
        overrides=dict(precision.overrides),
        form=policy.form,
        provider=policy.provider,
        machine=machine,
        date=date,
        ms=None if stage == "decode" else round(median_ms, 3),
        tokens_per_s=round(1000 / median_ms, 2) if stage == "decode" else None,
        tokens=None if stage == "vision_encoder" else tokens,
        chunk_tokens=artifacts.runtime.prefill_chunk_tokens if stage == "prefill" else None,
        threads=threads if target.providers[policy.provider].uses_cores else None,
        mode=target.power.mode,
        # Half the spread of the samples: what a repetition may differ by, not what another machine does.
        error=round(min(0.99, (max(times_ms) - min(times_ms)) / 2 / median_ms), 3),
        energy_j=None if energy_j is None else round(energy_j, 6),
    )


def points_toml(points: Sequence[Measured]) -> str:
    """The points as TOML to append to a target's file."""
    blocks = []
    for point in points:
        values = {key: value for key, value in plain(point).items() if value != {}}
        lines = [f"{key} = {_toml(value)}" for key, value in values.items()]
        blocks.append("\n".join(["[[measured]]", *lines]) + "\n")
    return "\n".join(blocks)


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)


@command_line("export.plan.measure")
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    p = argparse.ArgumentParser("python -m export.plan.measure", description=str(__doc__).partition("\n")[0])
    p.add_argument("directory", type=Path, metavar="DIR", help="artifact directory")
    p.add_argument("--machine", metavar="NAME", help="what to call this machine (default: its processor or board)")
    p.add_argument("--repeats", type=int, default=7, metavar="N", help="runs of every stage (default: 7)")
    p.add_argument("--json", metavar="FILE|-", help="write the points as JSON instead of TOML on standard output")
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        artifacts = load_artifacts(args.directory)
        provider = artifacts.graphs["vision_encoder"].session.provider
        machine = args.machine or read_device(provider).device
        date = datetime.date.today().isoformat()
        points = measure_points(args.directory, machine=machine, date=date, repeats=max(args.repeats, 3))
        if args.json is None:
            sys.stdout.write(points_toml(points))
        write_result(args.json, {"measured": [plain(point) for point in points]})
    except (ArtifactError, TargetError, OSError) as error:
        sys.stderr.write(f"export.plan.measure: {error}\n")
        return EXIT_BAD_INPUT
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
