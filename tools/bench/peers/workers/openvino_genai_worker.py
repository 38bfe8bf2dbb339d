"""OpenVINO GenAI: the same converted decoder in its own pipeline (paged attention, cached prefixes off)."""

from __future__ import annotations

import sys
from collections.abc import Mapping

import numpy as np
import openvino as ov
import openvino_genai as genai

from tools.bench.peers.workers.serve import Load, Task, serve
from tools.bench.peers.workload import DECODE_STEPS, Workload


def load(request: Load) -> Mapping[str, Task]:
    """Open the language model; times are GenAI's own: to the first token, and the mean of those after it."""
    workload = Workload(request.model)
    options = {key.partition(".")[2]: v for key, v in request.options.items() if key.startswith("language.")}
    folder = request.cache / request.model / "openvino" / f"language-{options.pop('form')}"
    if options.get("ATTENTION_BACKEND", "PA") == "PA":
        scheduler = genai.SchedulerConfig()
        # Every round has the same prompt: with prefixes cached, prefill would be measured once and then skipped.
        scheduler.enable_prefix_caching = False
        scheduler.max_num_batched_tokens = workload.prompt_tokens
        options["scheduler_config"] = scheduler
    pipeline = genai.LLMPipeline(
        str(folder), "CPU", INFERENCE_NUM_THREADS=request.threads, ENABLE_CPU_PINNING=False, **options
    )
    config = genai.GenerationConfig()
    config.max_new_tokens, config.ignore_eos, config.do_sample = DECODE_STEPS + 1, True, False
    ids = workload.text_ids(workload.prompt_tokens)[None]
    prompt = genai.TokenizedInputs(ov.Tensor(ids), ov.Tensor(np.ones_like(ids)))

    def run() -> dict[str, float]:
        made = pipeline.generate(prompt, config)
        if len(made.tokens[0]) != DECODE_STEPS + 1:
            raise ValueError(f"{len(made.tokens[0])} tokens generated, expected {DECODE_STEPS + 1}")
        times = made.perf_metrics
        return {"prefill_ms": times.get_ttft().mean, "decode_tokens_per_s": 1e3 / times.get_tpot().mean}

    return {"language": run}


if __name__ == "__main__":
    sys.exit(serve(load, ("openvino-genai", "openvino")))
