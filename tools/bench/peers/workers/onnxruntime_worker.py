"""Worker of ONNX Runtime with its usual API: the unsplit action expert, and the decoder of GenAI's builder.

Packages are imported where they are used, because the worker's memory is measured.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.bench.peers.workers.serve import Load, Task, language_task, serve, timed_task
from tools.bench.peers.workload import DECODE_STEPS, Workload


class Decoder:
    """Greedy decoding with GenAI's generator, which feeds its own last token."""

    def __init__(self, load: Load, workload: Workload) -> None:
        import onnxruntime_genai as genai

        self._genai = genai
        config = genai.Config(str(load.folder("genai", "language")))
        session = {"intra_op_num_threads": load.threads, "inter_op_num_threads": 1}
        config.overlay(json.dumps({"model": {"decoder": {"session_options": session}}}))
        self._model = genai.Model(config)
        self._params = genai.GeneratorParams(self._model)
        self._params.set_search_options(do_sample=False, max_length=workload.semantic_tokens + 8)
        self._generator: Any = None

    def prefill(self, ids: NDArray[np.int64]) -> int:
        """Start over with a prompt [S]; returns the next token."""
        self._generator = self._genai.Generator(self._model, self._params)
        self._generator.append_tokens(ids.astype(np.int32))
        return self.step(-1)

    def step(self, _token: int) -> int:
        """Return the next token."""
        self._generator.generate_next_token()
        return int(self._generator.get_next_tokens()[0])


def load(request: Load) -> Mapping[str, Task]:
    """Open the action expert or the language model."""
    workload = Workload(request.model)
    if request.parts == ("language",):
        decoder = Decoder(request, workload)
        ids = workload.text_ids(workload.prompt_tokens)
        return {"language": language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)}
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = request.threads
    options.inter_op_num_threads = 1
    path = request.folder("onnxruntime", "action") / "model.onnx"
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    feeds = workload.action_inputs()
    return {"action": timed_task("action_ms", lambda: session.run(None, feeds))}


if __name__ == "__main__":
    sys.exit(serve(load, ("onnxruntime", "onnxruntime-genai")))
