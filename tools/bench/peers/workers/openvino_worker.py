"""Worker of OpenVINO: encoder, unsplit action expert and stateful decoder, or the decoder in GenAI's pipeline.

Options are passed on as plugin properties. `python -m … openvino_genai`: the pipeline.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray

from tools.bench.peers.workers.serve import Load, Task, generation, language_task, serve, timed_task
from tools.bench.peers.workload import DECODE_STEPS, Workload


class Decoder:
    """Greedy decoding over the model's own cache."""

    def __init__(self, compiled: ov.CompiledModel) -> None:
        self._request = compiled.create_infer_request()
        self._length = 0

    def _infer(self, ids: NDArray[np.int64]) -> int:
        new = ids.shape[1]
        self._length += new
        feeds: dict[str, Any] = {
            "input_ids": ids,
            "attention_mask": np.ones((1, self._length), dtype=np.int64),
            "position_ids": np.arange(self._length - new, self._length, dtype=np.int64)[None],
            "beam_idx": np.zeros(1, dtype=np.int32),
        }
        self._request.infer(feeds, share_inputs=True, share_outputs=True)
        return int(self._request.get_output_tensor(0).data[0, -1].argmax())

    def prefill(self, ids: NDArray[np.int64]) -> int:
        """Start over with a prompt [1, S]; returns the next token."""
        self._request.reset_state()
        self._length = 0
        return self._infer(ids)

    def step(self, token: int) -> int:
        """Feed one token; returns the next."""
        return self._infer(np.array([[token]], dtype=np.int64))


def compiled(core: ov.Core, request: Load, part: str) -> ov.CompiledModel:
    """Compile a part's model in the form and with the precision hint of the options."""
    options = request.of(part)
    del options["form"]
    properties = {
        "INFERENCE_NUM_THREADS": request.threads,
        "NUM_STREAMS": 1,
        "PERFORMANCE_HINT": "LATENCY",
        # The harness pins the process; the plugin's pinning would include cores that it must not use.
        "ENABLE_CPU_PINNING": False,
        **options,
    }
    model = request.folder("openvino", part) / "openvino_model.xml"
    return core.compile_model(str(model), "CPU", properties)


def load(request: Load) -> Mapping[str, Task]:
    """Open the requested parts."""
    workload, core = Workload(request.model), ov.Core()
    tasks: dict[str, Task] = {}
    if "encoder" in request.parts:
        vision = compiled(core, request, "encoder").create_infer_request()
        see = partial(vision.infer, share_inputs=True, share_outputs=True)
        frame = workload.frame()
        tasks["encoder"] = timed_task("encoder_ms", lambda: see([frame]))
    if "action" in request.parts:
        action = compiled(core, request, "action").create_infer_request()
        visual, *rest = workload.action_inputs().values()
        plan = partial(action.infer, share_inputs=True, share_outputs=True)
        tasks["action"] = timed_task("action_ms", lambda: plan([visual, *rest]))
        if "encoder" in request.parts:

            def tick() -> None:
                tokens = see([frame])[0]
                plan([tokens, *rest])

            tasks["tick"] = timed_task("tick_ms", tick)
    if "language" in request.parts:
        decoder = Decoder(compiled(core, request, "language"))
        ids = workload.text_ids(workload.prompt_tokens)[None]
        tasks["language"] = language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)
    return tasks


def load_genai(request: Load) -> Mapping[str, Task]:
    """Open the language model; GenAI measures the times: to the first token, and the mean of the later ones."""
    import openvino_genai as genai  # imported here, because the worker's memory is measured

    workload = Workload(request.model)
    options: dict[str, Any] = request.of("language")
    del options["form"]
    scheduler = options["scheduler_config"] = genai.SchedulerConfig()
    # Every round has the same prompt: a prefix cache would skip all prefills but the first.
    scheduler.enable_prefix_caching = False
    scheduler.max_num_batched_tokens = workload.prompt_tokens
    options |= {"INFERENCE_NUM_THREADS": request.threads, "ENABLE_CPU_PINNING": False}
    pipeline = genai.LLMPipeline(str(request.folder("openvino", "language")), "CPU", **options)
    config = genai.GenerationConfig()
    config.max_new_tokens, config.ignore_eos, config.do_sample = DECODE_STEPS + 1, True, False
    ids = workload.text_ids(workload.prompt_tokens)[None]
    prompt = genai.TokenizedInputs(ov.Tensor(ids), ov.Tensor(np.ones_like(ids)))

    def run() -> dict[str, float]:
        made = pipeline.generate(prompt, config)
        if len(made.tokens[0]) != DECODE_STEPS + 1:
            raise ValueError(f"{len(made.tokens[0])} tokens generated, expected {DECODE_STEPS + 1}")
        times = made.perf_metrics
        return generation(times.get_ttft().mean, DECODE_STEPS * times.get_tpot().mean, DECODE_STEPS)

    return {"language": run}


if __name__ == "__main__":
    if sys.argv[1] == "openvino_genai":
        sys.exit(serve(load_genai, ("openvino-genai", "openvino")))
    sys.exit(serve(load, ("openvino", "nncf")))
