"""OpenVINO: encoder, unsplit action expert and stateful decoder; options are passed on as plugin properties."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray

from tools.bench.peers.workers.serve import Load, Task, action_task, encoder_task, language_task, serve, tick_task
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


class Openvino:
    """Opens converted models with `threads` threads; `encoder.hint` etc. choose precision hints by part."""

    def __init__(self, load: Load) -> None:
        self._load = load
        self._core = ov.Core()
        self._folder = load.cache / load.model / "openvino"

    def open(self, part: str) -> ov.CompiledModel:
        """The part's model in the form that the options name."""
        options = {key.partition(".")[2]: v for key, v in self._load.options.items() if key.startswith(part + ".")}
        model = self._folder / f"{part}-{options.pop('form')}" / "openvino_model.xml"
        properties = {
            "INFERENCE_NUM_THREADS": self._load.threads,
            "NUM_STREAMS": 1,
            "PERFORMANCE_HINT": "LATENCY",
            # The harness pins the process; the plugin's own pinning would count cores that it may not use.
            "ENABLE_CPU_PINNING": False,
            **options,
        }
        return self._core.compile_model(str(model), "CPU", properties)


def load(request: Load) -> Mapping[str, Task]:
    """Open the parts asked for."""
    workload, runtime = Workload(request.model), Openvino(request)
    tasks: dict[str, Task] = {}
    if "encoder" in request.parts:
        vision = runtime.open("encoder").create_infer_request()
        frame = workload.frame()
        tasks["encoder"] = encoder_task(lambda: vision.infer([frame], share_inputs=True, share_outputs=True))
    if "action" in request.parts:
        action = runtime.open("action").create_infer_request()
        shape = (1, workload.config.vision.tokens, workload.config.vision.token_dim)
        visual = np.random.default_rng(2).standard_normal(shape).astype(np.float32)
        rest = [workload.state(), workload.latency(), workload.last_layer_kv()]
        tasks["action"] = action_task(lambda: action.infer([visual, *rest], share_inputs=True, share_outputs=True))
        if "encoder" in request.parts:

            def tick() -> None:
                tokens = vision.infer([frame], share_inputs=True, share_outputs=True)[0]
                action.infer([tokens, *rest], share_inputs=True, share_outputs=True)

            tasks["tick"] = tick_task(tick)
    if "language" in request.parts:
        decoder = Decoder(runtime.open("language"))
        ids = workload.text_ids(workload.prompt_tokens)[None]
        tasks["language"] = language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)
    return tasks


if __name__ == "__main__":
    sys.exit(serve(load, ("openvino", "nncf")))
