"""Writes the shared weights of all contenders: our network, seed 0, its language model as a Hugging Face directory.

The peers run encoder and action expert as PyTorch modules, the latter in one piece.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from export.model.action import ActionExpert
from export.model.config import LanguageConfig, TicVlaConfig
from export.model.network import build
from export.model.vision import VisionEncoder, pixel_shuffle_v2
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
    """Return the Qwen2 checkpoint's name of a tensor of the language model."""
    head, *rest = name.split(".")
    if head == "layers":
        number, layer, kind = rest
        return f"model.layers.{number}.{LAYER_NAMES[layer]}.{kind}"
    return {"embed": "model.embed_tokens", "norm": "model.norm", "lm_head": "lm_head"}[head] + "." + rest[0]


def qwen_config(c: LanguageConfig, dtype: str) -> dict[str, object]:
    """Return `config.json` of the Qwen2 checkpoint."""
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
    """Write a Qwen2 directory; its tokenizer only names ids, because every contender reads ids."""
    from tokenizers import (
        Tokenizer,
        models,
    )  # imported here, because the memory of a worker that imports this module is measured

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


class UnsplitAction(nn.Module):
    """Action expert with context projection and step in one forward pass, as the peers run it."""

    def __init__(self, expert: ActionExpert) -> None:
        super().__init__()
        self.expert = expert

    def forward(self, visual_tokens: Tensor, state: Tensor, latency: Tensor, last_layer_kv: Tensor) -> Tensor:
        """Plan a trajectory [1, steps, 3] from visual tokens, state, latency and the semantic state [1, T, kv_dim]."""
        keys, values = self.expert.context(last_layer_kv)
        trajectory: Tensor = self.expert(visual_tokens, state, latency, keys, values)
        return trajectory


class FixedEncoder(nn.Module):
    """Encoder with a constant grid size: a tracer cannot compute the root of a traced token count."""

    def __init__(self, encoder: VisionEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, frame: Tensor) -> Tensor:
        """Encode a frame [1, px, px, 3] to visual tokens [1, N, D]."""
        e, c = self.encoder, self.encoder.config
        pixels = ((frame.float() - e.mean) * e.inv_std).to(e.cls.dtype)
        x = e.embed(pixels.permute(0, 3, 1, 2)).flatten(2).transpose(1, 2)
        x = torch.cat([e.cls, x], dim=1) + e.position
        for block in e.blocks:
            x = block(x)
        x = x[:, 1:].reshape(1, c.grid, c.grid, c.hidden)
        if c.pixel_shuffle > 1:
            x = pixel_shuffle_v2(x, c.pixel_shuffle)
        tokens: Tensor = e.projector(x.reshape(1, c.tokens, c.hidden * c.pixel_shuffle**2))
        return tokens


def _filled(module: nn.Module, path: Path) -> None:
    module.load_state_dict(load_file(str(path)), assign=True)
    module.eval().requires_grad_(False)


def load_vision(config: TicVlaConfig, reference: Path) -> FixedEncoder:
    """Load the encoder with the reference's weights."""
    # "meta" allocates nothing: weights that are replaced at once must not count in a peer's peak memory.
    with torch.device("meta"):
        encoder = VisionEncoder(config.vision)
    encoder.mean = torch.tensor(config.vision.mean) * 255
    encoder.inv_std = 1 / (torch.tensor(config.vision.std) * 255)
    _filled(encoder, reference / "vision.safetensors")
    return FixedEncoder(encoder)


def load_action(config: TicVlaConfig, reference: Path) -> UnsplitAction:
    """Load the unsplit action expert with the reference's weights."""
    with torch.device("meta"):
        expert = ActionExpert(config)
    _filled(expert, reference / "action.safetensors")
    return UnsplitAction(expert)
