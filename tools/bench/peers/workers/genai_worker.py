"""ONNX Runtime GenAI: the decoder that its own builder writes, fed with ids."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping

import numpy as np
import onnxruntime_genai as genai
from numpy.typing import NDArray

from tools.bench.peers.workers.serve import Load, Task, language_task, serve
from tools.bench.peers.workload import DECODE_STEPS, Workload


class Decoder:
    """Greedy decoding with GenAI's generator."""

    def __init__(self, load: Load, workload: Workload) -> None:
        folder = load.cache / load.model / "genai" / f"language-{load.options['language.form']}"
        config = genai.Config(str(folder))
        session = {"intra_op_num_threads": load.threads, "inter_op_num_threads": 1}
        config.overlay(json.dumps({"model": {"decoder": {"session_options": session}}}))
        self._model = genai.Model(config)
        self._params = genai.GeneratorParams(self._model)
        self._params.set_search_options(do_sample=False, max_length=workload.semantic_tokens + 8)
        self._generator: genai.Generator | None = None

    def prefill(self, ids: NDArray[np.int64]) -> int:
        """Start over with a prompt [S]; returns the next token."""
        self._generator = genai.Generator(self._model, self._params)
        self._generator.append_tokens(ids.astype(np.int32))
        return self._choose()

    def _choose(self) -> int:
        assert self._generator is not None
        self._generator.generate_next_token()
        return int(self._generator.get_next_tokens()[0])

    def step(self, token: int) -> int:
        """The generator feeds its own last token; returns the next."""
        return self._choose()


def load(request: Load) -> Mapping[str, Task]:
    """Open the language model."""
    workload = Workload(request.model)
    decoder = Decoder(request, workload)
    ids = workload.text_ids(workload.prompt_tokens)
    return {"language": language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)}


if __name__ == "__main__":
    sys.exit(serve(load, ("onnxruntime-genai", "onnxruntime")))
