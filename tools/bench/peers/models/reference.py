"""The weights that all contenders share: our network, seed 0, its language model as a Hugging Face directory."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import save_file
from tokenizers import Tokenizer, models
from torch import Tensor

from export.model.config import LanguageConfig
from export.model.network import build
from tools.bench.peers.workload import SEED, Workload

LAYER_NAMES = {
    "q": "self_attn.q_proj",
    "k": "self_attn.k_proj",
    "v": "self_attn.v_proj",
    "o": "self_attn.o_proj",
    "gate": "mlp.gate_proj",
    "up": "mlp.up_proj",
    "down": "mlp.down_proj",
    "input_norm": "input_layernorm",
    "mlp_norm": "post_attention_layernorm",
}
"""Our names inside a decoder layer → those of a Qwen2 checkpoint."""


def qwen_name(name: str) -> str:
    """Name of one of our language model's tensors in a Qwen2 checkpoint."""
    head, *rest = name.split(".")
    if head == "layers":
        number, layer, kind = rest
        return f"model.layers.{number}.{LAYER_NAMES[layer]}.{kind}"
    return {"embed": "model.embed_tokens", "norm": "model.norm", "lm_head": "lm_head"}[head] + "." + rest[0]


def qwen_config(c: LanguageConfig, dtype: str) -> dict[str, object]:
    """`config.json` of the Qwen2 checkpoint."""
    return {
        "architectures": ["Qwen2ForCausalLM"],
        "model_type": "qwen2",
        "hidden_size": c.hidden,
        "num_hidden_layers": c.layers,
        "num_attention_heads": c.heads,
        "num_key_value_heads": c.kv_heads,
        "head_dim": c.head_dim,
        "intermediate_size": c.mlp,
        "vocab_size": c.vocab,
        "rope_theta": c.rope_theta,
        "rms_norm_eps": c.rms_eps,
        "hidden_act": "silu",
        "max_position_embeddings": c.max_context,
        "tie_word_embeddings": False,
        "use_sliding_window": False,
        "attention_dropout": 0.0,
        "bos_token_id": c.im_start_id,
        "eos_token_id": c.im_end_id,
        "torch_dtype": dtype,
    }


def write_hugging_face(folder: Path, config: LanguageConfig, tensors: dict[str, Tensor], dtype: str) -> None:
    """Write a Qwen2 directory; its tokenizer only names ids, since every contender is given ids."""
    folder.mkdir(parents=True, exist_ok=True)
    kind = {"float32": torch.float32, "bfloat16": torch.bfloat16}[dtype]
    save_file({name: t.to(kind) for name, t in tensors.items()}, str(folder / "model.safetensors"), {"format": "pt"})
    (folder / "config.json").write_text(json.dumps(qwen_config(config, dtype), indent=1), encoding="utf-8")
    (folder / "generation_config.json").write_text(json.dumps({"do_sample": False}), encoding="utf-8")
    words = {f"t{i}": i for i in range(config.vocab)}
    Tokenizer(models.WordLevel(words, unk_token="t0")).save(str(folder / "tokenizer.json"))
    head = {"tokenizer_class": "PreTrainedTokenizerFast", "eos_token": f"t{config.im_end_id}", "unk_token": "t0"}
    (folder / "tokenizer_config.json").write_text(json.dumps(head), encoding="utf-8")


def write_reference(workload: Workload, folder: Path) -> None:
    """Write `vision`, `action` (safetensors) and the language model in fp32 and bf16."""
    model = build(workload.config, SEED)
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in (("vision", model.vision), ("action", model.action)):
        save_file({k: v.contiguous() for k, v in part.state_dict().items()}, str(folder / f"{name}.safetensors"))
    language = {
        qwen_name(name): tensor.contiguous()
        for name, tensor in model.language.state_dict().items()
        if not name.startswith("merge")
    }
    config = workload.config.language
    for dtype, place in (("float32", "language"), ("bfloat16", "language-bf16")):
        write_hugging_face(folder / place, config, language, dtype)
