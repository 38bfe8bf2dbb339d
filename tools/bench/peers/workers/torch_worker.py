"""Worker of eager PyTorch and transformers: encoder, unsplit action expert, and Qwen2ForCausalLM."""

from __future__ import annotations

import sys
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import DynamicCache, Qwen2ForCausalLM

from tools.bench.peers.models.reference import load_action, load_vision
from tools.bench.peers.workers.serve import Load, Task, language_task, serve, timed_task
from tools.bench.peers.workload import DECODE_STEPS, Workload

FORMS = ("fp32", "bf16", "int8")


def in_form(module: nn.Module, form: str) -> nn.Module:
    """Convert the module to bf16, or quantise its linear layers dynamically."""
    if form not in FORMS:
        raise ValueError(f"form {form!r}: expected one of {FORMS}")
    if form == "int8":
        from torch.ao.quantization import quantize_dynamic

        quantised: nn.Module = quantize_dynamic(module, {nn.Linear}, dtype=torch.qint8)
        return quantised
    return module.to(torch.bfloat16) if form == "bf16" else module


class Decoder:
    """Greedy decoding with transformers' own cache."""

    def __init__(self, load: Load, form: str) -> None:
        folder = load.cache / load.model / "reference" / ("language-bf16" if form == "bf16" else "language")
        dtype = torch.bfloat16 if form == "bf16" else torch.float32
        model = Qwen2ForCausalLM.from_pretrained(folder, dtype=dtype, attn_implementation="sdpa")
        self._model = in_form(model.eval(), form)
        self._cache = DynamicCache(config=model.config)

    def _next(self, ids: Tensor) -> int:
        with torch.inference_mode():
            out = self._model(input_ids=ids, past_key_values=self._cache, use_cache=True, logits_to_keep=1)
        return int(out.logits[0, -1].argmax())

    def prefill(self, ids: NDArray[np.int64]) -> int:
        """Start over with a prompt [1, S]; returns the next token."""
        self._cache = DynamicCache(config=self._model.config)
        return self._next(torch.from_numpy(ids))

    def step(self, token: int) -> int:
        """Feed one token; returns the next."""
        return self._next(torch.tensor([[token]]))


def load(request: Load) -> Mapping[str, Task]:
    """Open the requested parts."""
    torch.set_num_threads(request.threads)
    workload, reference = Workload(request.model), request.cache / request.model / "reference"
    form = {part: request.options.get(f"{part}.form", "bf16") for part in request.parts}
    tasks: dict[str, Task] = {}
    if "encoder" in request.parts:
        vision = in_form(load_vision(workload.config, reference), form["encoder"])
        frame = torch.from_numpy(workload.frame())

        def encode() -> Tensor:
            with torch.inference_mode():
                tokens: Tensor = vision(frame)
            return tokens

        tasks["encoder"] = timed_task("encoder_ms", encode)
    if "action" in request.parts:
        action = in_form(load_action(workload.config, reference), form["action"])
        kind = torch.bfloat16 if form["action"] == "bf16" else torch.float32
        visual, *rest = (torch.from_numpy(x).to(kind) for x in workload.action_inputs().values())

        def act(tokens: Tensor) -> Tensor:
            with torch.inference_mode():
                trajectory: Tensor = action(tokens, *rest)
            return trajectory

        tasks["action"] = timed_task("action_ms", lambda: act(visual))
        if "encoder" in request.parts:
            tasks["tick"] = timed_task("tick_ms", lambda: act(encode().to(kind)))
    if "language" in request.parts:
        decoder = Decoder(request, form["language"])
        ids = workload.text_ids(workload.prompt_tokens)[None]
        tasks["language"] = language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)
    return tasks


if __name__ == "__main__":
    sys.exit(serve(load, ("torch", "transformers")))
