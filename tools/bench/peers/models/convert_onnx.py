"""ONNX forms of the peers of our own stack: the unsplit action expert, and ONNX Runtime GenAI's own builder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import onnx
import torch
from onnxruntime.quantization import QuantType, quantize_dynamic

from tools.bench.peers.models.unsplit import load_action
from tools.bench.peers.workload import Workload

GENAI_OPTIONS = {
    "int4": ["int4_block_size=128", "int4_accuracy_level=4"],
    "int4-b32": ["int4_block_size=32", "int4_accuracy_level=4"],
    "int8": [],
}


def write_action(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write the unsplit action expert in `fp32` or with dynamic `int8` (u8 activations, s8 weights)."""
    folder.mkdir(parents=True, exist_ok=True)
    config = workload.config
    visual = torch.zeros(1, config.vision.tokens, config.vision.token_dim)
    given = (workload.state(), workload.latency(), workload.last_layer_kv())
    plain = folder / "plain.onnx"
    target = plain if kind == "int8" else folder / "model.onnx"
    torch.onnx.export(
        load_action(config, reference),
        (visual, *(torch.from_numpy(x) for x in given)),
        str(target),
        input_names=["visual_tokens", "state", "latency", "last_layer_kv"],
        output_names=["trajectory"],
        external_data=False,
        dynamo=True,
    )
    if kind == "int8":
        # The exporter's notes on inner shapes contradict its transposed weights, and the quantiser believes them.
        model = onnx.load(plain)
        del model.graph.value_info[:]
        onnx.save(model, plain)
        quantize_dynamic(plain, folder / "model.onnx", weight_type=QuantType.QInt8, per_channel=True)
        plain.unlink()


def write_genai(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Run the builder of ONNX Runtime GenAI on the Hugging Face directory of the workload's model."""
    precision = kind.partition("-")[0]
    command = [sys.executable, "-m", "onnxruntime_genai.models.builder", "-i", str(reference / "language")]
    command += ["-o", str(folder), "-p", precision, "-e", "cpu", "-c", str(folder / "builder-cache")]
    if GENAI_OPTIONS[kind]:
        command += ["--extra_options", *GENAI_OPTIONS[kind]]
    subprocess.run(command, check=True)
