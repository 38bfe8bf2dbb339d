"""Writes the language model for llama.cpp: Qwen2 tensors in Q4_0 or Q8_0, without vocabulary (inputs are ids)."""

from __future__ import annotations

from pathlib import Path

import gguf
import numpy as np
from gguf.quants import quantize
from safetensors import safe_open

from export.model.config import LanguageConfig
from tools.bench.peers.workload import Workload

NAMES = {
    "self_attn.q_proj": "attn_q",
    "self_attn.k_proj": "attn_k",
    "self_attn.v_proj": "attn_v",
    "self_attn.o_proj": "attn_output",
    "mlp.gate_proj": "ffn_gate",
    "mlp.up_proj": "ffn_up",
    "mlp.down_proj": "ffn_down",
    "input_layernorm": "attn_norm",
    "post_attention_layernorm": "ffn_norm",
}
TYPES = {"q4_0": gguf.GGMLQuantizationType.Q4_0, "q8_0": gguf.GGMLQuantizationType.Q8_0}
FILE_TYPES = {"q4_0": gguf.LlamaFileType.MOSTLY_Q4_0, "q8_0": gguf.LlamaFileType.MOSTLY_Q8_0}
SLAB_ROWS = 8192
BLOCK = 32
"""Columns per scale; a matrix whose width is no multiple stays in fp16 (none at full size)."""


def gguf_name(name: str) -> str:
    """Return llama.cpp's name of a Qwen2 tensor."""
    parts = name.split(".")
    if parts[1] == "layers":
        return f"blk.{parts[2]}.{NAMES['.'.join(parts[3:-1])]}.{parts[-1]}"
    return {"model.embed_tokens": "token_embd", "model.norm": "output_norm", "lm_head": "output"}[
        name.rpartition(".")[0]
    ] + ".weight"


def write_gguf(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write `model.gguf`; matrices in the kind named, the rest in fp32."""
    c: LanguageConfig = workload.config.language
    folder.mkdir(parents=True, exist_ok=True)
    writer = gguf.GGUFWriter(str(folder / "model.gguf"), "qwen2")
    writer.add_context_length(c.max_context)
    writer.add_embedding_length(c.hidden)
    writer.add_block_count(c.layers)
    writer.add_feed_forward_length(c.mlp)
    writer.add_head_count(c.heads)
    writer.add_head_count_kv(c.kv_heads)
    writer.add_key_length(c.head_dim)
    writer.add_value_length(c.head_dim)
    writer.add_rope_freq_base(c.rope_theta)
    writer.add_layer_norm_rms_eps(c.rms_eps)
    writer.add_vocab_size(c.vocab)
    writer.add_tokenizer_model("none")
    writer.add_file_type(FILE_TYPES[kind])
    with safe_open(str(reference / "language" / "model.safetensors"), framework="np") as file:
        for name in sorted(file.keys()):
            tensor = file.get_tensor(name)
            if tensor.ndim == 1:
                writer.add_tensor(gguf_name(name), tensor)
                continue
            if tensor.shape[1] % BLOCK:
                writer.add_tensor(gguf_name(name), tensor.astype(np.float16))
                continue
            # In slabs of rows, because the quantiser makes several copies.
            slabs = [quantize(tensor[i : i + SLAB_ROWS], TYPES[kind]) for i in range(0, len(tensor), SLAB_ROWS)]
            writer.add_tensor(gguf_name(name), np.concatenate(slabs), raw_dtype=TYPES[kind])
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
