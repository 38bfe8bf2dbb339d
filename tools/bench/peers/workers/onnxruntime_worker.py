"""ONNX Runtime as anybody would use it: the unsplit action expert, exported plainly."""

from __future__ import annotations

import sys
from collections.abc import Mapping

import numpy as np
import onnxruntime as ort

from tools.bench.peers.workers.serve import Load, Task, action_task, serve
from tools.bench.peers.workload import Workload


def load(request: Load) -> Mapping[str, Task]:
    """Open the action expert."""
    workload = Workload(request.model)
    options = ort.SessionOptions()
    options.intra_op_num_threads = request.threads
    options.inter_op_num_threads = 1
    path = request.cache / request.model / "onnxruntime" / f"action-{request.options['action.form']}" / "model.onnx"
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    shape = (1, workload.config.vision.tokens, workload.config.vision.token_dim)
    feeds = {
        "visual_tokens": np.random.default_rng(2).standard_normal(shape).astype(np.float32),
        "state": workload.state(),
        "latency": workload.latency(),
        "last_layer_kv": workload.last_layer_kv(),
    }
    return {"action": action_task(lambda: session.run(None, feeds))}


if __name__ == "__main__":
    sys.exit(serve(load, ("onnxruntime",)))
