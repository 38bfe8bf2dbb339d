"""Prints a graph's time by operator: ONNX Runtime's profile of the artifacts on this machine.

python -m tools.bench.profile --artifacts out/cpu --graphs language_model.decode --context 1100 --threads 2 --json -
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_DONE, check_result_target, command_line, write_result
from edge.inference.graph import DTYPES, Array
from tools.bench import bad_input, command_parser

CALLS = {"vision_encoder": 5, "language_model": 10, "language_model.prefill": 5, "language_model.decode": 40}
KERNEL = "_kernel_time"


def feeds_for(artifacts: Artifacts, name: str, context: int) -> dict[str, Array]:
    """Build inputs with the shapes of a run: one token after `context` others for a decoder, 128 for a prefill."""
    rng = np.random.default_rng(0)
    new = 128 if name == "language_model.prefill" else 1
    axes = {"S": new, "F": 1, "T": context, "C": artifacts.runtime.max_context}
    feeds: dict[str, Array] = {}
    for tensor in artifacts.graphs[name].inputs:
        shape = [axis if isinstance(axis, int) else axes[axis] for axis in tensor.shape]
        dtype = DTYPES[tensor.dtype]
        noise = rng.integers(0, 256, shape) if dtype is np.uint8 else rng.standard_normal(shape)
        feeds[tensor.name] = (noise if dtype in (np.uint8, np.float32, np.float16) else np.zeros(shape)).astype(dtype)
    if "input_ids" in feeds:
        feeds["seqlens_k"] = np.array([context + new - 1], dtype=np.int32)
        feeds["total_sequence_length"] = np.array(context + new, dtype=np.int32)
    return feeds


def profile(artifacts: Artifacts, name: str, *, context: int, threads: int) -> dict[str, Any]:
    """Measure the time per call by operator, ms, largest first; the first call, which allocates, is ignored."""
    contract = artifacts.graphs[name]
    calls = CALLS.get(name, 40)
    with tempfile.TemporaryDirectory() as folder:
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry(
            "session.model_external_initializers_file_folder_path", str(artifacts.directory)
        )
        session = ort.InferenceSession(
            artifacts.contents[contract.file], sess_options=options, providers=["CPUExecutionProvider"]
        )
        binding = session.io_binding()
        for key, value in feeds_for(artifacts, name, context).items():
            bound = ort.OrtValue.ortvalue_from_numpy(value)
            binding.bind_ortvalue_input(key, bound)
            if key.startswith("past_key_values"):
                binding.bind_ortvalue_output(key.replace("past_key_values", "present"), bound)
        for tensor in contract.outputs:
            if not tensor.name.startswith("present"):
                binding.bind_output(tensor.name)
        for _ in range(calls + 1):
            session.run_with_iobinding(binding)
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    kernels = [e for e in events if e.get("cat") == "Node" and e["name"].endswith(KERNEL)]
    counted = kernels[len(kernels) // (calls + 1) :]
    total, count = Counter[str](), Counter[str]()
    for event in counted:
        total[event["args"]["op_name"]] += event["dur"]
        count[event["args"]["op_name"]] += 1
    return {
        "calls": calls,
        "threads": threads,
        "total_ms": sum(total.values()) / 1e3 / calls,
        "operators": {op: {"ms": us / 1e3 / calls, "nodes": count[op] // calls} for op, us in total.most_common()},
        "tagged": "measured",
    }


@command_line("profile")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--graphs", nargs="*", metavar="NAME", help="graphs to profile (default: all)")
    p.add_argument("--context", type=int, default=1100, help="tokens before the new one (default: 1100)")
    p.add_argument("--threads", type=int, default=2)
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        artifacts = load_artifacts(args.artifacts.absolute())
        names = args.graphs or list(artifacts.graphs)
        unknown = sorted(set(names) - set(artifacts.graphs))
        if unknown:
            raise ArtifactError(f"--graphs {unknown[0]}: expected some of {', '.join(artifacts.graphs)}")
        if not 1 <= args.context <= artifacts.runtime.max_context - 128 or args.threads < 1:
            raise ArtifactError(f"--context {args.context}: expected 1 to {artifacts.runtime.max_context - 128}")
        result = {name: profile(artifacts, name, context=args.context, threads=args.threads) for name in names}
        write_result(args.json, result)
    except (ArtifactError, OSError) as error:
        return bad_input("profile", error)
    if args.json != "-":
        for name, found in result.items():
            print(f"{name}: {found['total_ms']:.2f} ms a call, {args.threads} threads")
            for operator, entry in list(found["operators"].items())[:8]:
                share = 100 * entry["ms"] / found["total_ms"]
                print(f"  {operator:34s} {entry['ms']:9.3f} ms  {share:4.0f} %  {entry['nodes']} nodes")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
