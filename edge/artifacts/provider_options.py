"""Options of execution providers that a manifest may give: numbers and choices, nothing that names a file.

Some providers load code from a path in their options (TensorRT's plug-ins, a CUDA graph's external libraries), and a
data file of an artifact directory may hold anything. The folders of engines come from `edge.inference.engines`, not
from here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from edge.core.device import CUDA, OPENVINO, TENSORRT

ALLOWED: Final[Mapping[str, frozenset[str]]] = {
    TENSORRT: frozenset(
        {
            "trt_builder_optimization_level",
            "trt_context_memory_sharing_enable",
            "trt_engine_cache_enable",
            "trt_fp16_enable",
            "trt_int8_enable",
            "trt_layer_norm_fp32_fallback",
            "trt_max_workspace_size",
            "trt_profile_max_shapes",
            "trt_profile_min_shapes",
            "trt_profile_opt_shapes",
            "trt_timing_cache_enable",
        }
    ),
    CUDA: frozenset(
        {
            "arena_extend_strategy",
            "cudnn_conv_algo_search",
            "cudnn_conv_use_max_workspace",
            "do_copy_in_default_stream",
            "gpu_mem_limit",
            "prefer_nhwc",
            "use_tf32",
        }
    ),
    OPENVINO: frozenset({"device_type", "num_of_threads", "num_streams", "precision"}),
}
"""Those of the shipped targets, and others of their kind for targets of one's own."""
_VALUE: Final = re.compile(r"[A-Za-z0-9_.:,+-]{0,4096}", re.ASCII)


def wrong_option(provider: str, options: Mapping[str, str]) -> str | None:
    """What is wrong with the options of a provider, in words; None if nothing is."""
    allowed = ALLOWED.get(provider, frozenset())
    for key, value in options.items():
        if key not in allowed:
            return f"option {key!r} of {provider} is not one that the runner passes on; expected " + (
                ", ".join(sorted(allowed)) or "none"
            )
        if not _VALUE.fullmatch(value) or ".." in value:
            return f"option {key} is {value[:80]!r}; expected a number, a choice or shapes, and no path"
    return None
