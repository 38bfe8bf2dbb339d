"""Writes the ONNX peers: the unsplit action expert, and ONNX Runtime GenAI's model by its own builder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import onnx
import torch
from onnxruntime.quantization import QuantType, quantize_dynamic

from tools.bench.peers.models.reference import load_action
from tools.bench.peers.workload import Workload


def write_action(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write the unsplit action expert in `fp32` or with dynamic `int8` (u8 activations, s8 weights)."""
    folder.mkdir(parents=True, exist_ok=True)
    inputs = workload.action_inputs()
    plain = folder / "plain.onnx"
    target = plain if kind == "int8" else folder / "model.onnx"
    torch.onnx.export(
        load_action(workload.config, reference),
        tuple(map(torch.from_numpy, inputs.values())),
        str(target),
        input_names=list(inputs),
        output_names=["trajectory"],
        external_data=False,
        dynamo=True,
    )
    if kind == "int8":
        # The exporter's inner shapes contradict its transposed weights and mislead the quantiser.
        model = onnx.load(plain)
        del model.graph.value_info[:]
        onnx.save(model, plain)
        quantize_dynamic(plain, folder / "model.onnx", weight_type=QuantType.QInt8, per_channel=True)
        plain.unlink()


def write_genai(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Run the builder of ONNX Runtime GenAI on the Hugging Face directory of the workload's model, in `int4`."""
    command = [sys.executable, "-m", "onnxruntime_genai.models.builder", "-i", str(reference / "language")]
    command += ["-o", str(folder), "-p", kind, "-e", "cpu", "-c", str(folder / "builder-cache")]
    command += ["--extra_options", "int4_block_size=128", "int4_accuracy_level=4"]
    subprocess.run(command, check=True)
