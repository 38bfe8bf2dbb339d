"""llama.cpp through its C interface: prefill in one batch of ids, then one id a step."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Mapping

import llama_cpp as llama
import numpy as np
from numpy.typing import NDArray

from tools.bench.peers.workers.serve import Load, Task, language_task, serve
from tools.bench.peers.workload import DECODE_STEPS, Workload

BOOLEANS = {"true": True, "false": False}
LOAD_MODES = {"read": llama.LLAMA_LOAD_MODE_NONE, "mapped": llama.LLAMA_LOAD_MODE_MMAP}


class Decoder:
    """Greedy decoding; options: `extra_buffers` (repacking), `weights` (mapped, read)."""

    def __init__(self, load: Load, workload: Workload) -> None:
        options, path = load.of("language"), load.folder("llama", "language") / "model.gguf"
        del options["form"]
        model = llama.llama_model_default_params()
        model.n_gpu_layers = 0
        model.use_extra_bufts = BOOLEANS[options.pop("extra_buffers", "true")]
        model.load_mode = LOAD_MODES[options.pop("weights", "mapped")]
        self._model = llama.llama_model_load_from_file(str(path).encode(), model)
        if not self._model:
            raise RuntimeError(f"{path}: llama.cpp cannot open it")
        context = llama.llama_context_default_params()
        context.n_ctx = 256 * (-(-(workload.semantic_tokens + 8) // 256))
        context.n_batch = workload.prompt_tokens
        context.n_ubatch = 512
        context.n_threads = context.n_threads_batch = load.threads
        if options:
            raise ValueError(f"unknown options {sorted(options)}")
        self._context = llama.llama_init_from_model(self._model, context)
        if not self._context:
            raise RuntimeError("llama.cpp cannot make a context")
        self._vocab = workload.config.language.vocab

    def _decode(self, ids: NDArray[np.int64]) -> int:
        tokens = (ctypes.c_int32 * len(ids))(*ids.tolist())
        if llama.llama_decode(self._context, llama.llama_batch_get_one(tokens, len(ids))):
            raise RuntimeError("llama_decode failed")
        logits = llama.llama_get_logits_ith(self._context, -1)
        return int(np.ctypeslib.as_array(logits, shape=(self._vocab,)).argmax())

    def prefill(self, ids: NDArray[np.int64]) -> int:
        """Start over with a prompt [S]; returns the next token."""
        llama.llama_memory_clear(llama.llama_get_memory(self._context), True)
        return self._decode(ids)

    def step(self, token: int) -> int:
        """Feed one token; returns the next."""
        return self._decode(np.array([token]))


def load(request: Load) -> Mapping[str, Task]:
    """Open the language model; llama.cpp does not run the other parts."""
    if request.parts != ("language",):
        raise ValueError(f"llama.cpp runs the language model only, found {list(request.parts)}")
    workload = Workload(request.model)
    llama.llama_backend_init()
    decoder = Decoder(request, workload)
    ids = workload.text_ids(workload.prompt_tokens)
    return {"language": language_task(lambda: decoder.prefill(ids), decoder.step, DECODE_STEPS)}


if __name__ == "__main__":
    sys.exit(serve(load, ("llama-cpp-python",)))
