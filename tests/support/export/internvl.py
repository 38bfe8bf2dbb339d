"""A small random InternVL by Hugging Face `transformers`, and its tensors under OpenGVLab's own names."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from export.checkpoint.load import load_checkpoint
from export.model.config import ActionConfig, LanguageConfig, TicVlaConfig, VisionConfig
from export.model.weights import CheckpointError
from tools.bench.parity_1b import internvl_config

CONFIG = TicVlaConfig(
    name="small",
    vision=VisionConfig(image_px=84, hidden=32, layers=2, heads=2, mlp=64, token_dim=32),
    language=LanguageConfig(
        hidden=32,
        layers=3,
        heads=4,
        kv_heads=2,
        head_dim=8,
        mlp=48,
        vocab=200,
        max_context=256,
        im_start_id=6,
        im_end_id=7,
        img_start_id=8,
        img_end_id=9,
        img_context_id=10,
    ),
    action=ActionConfig(hidden=32, layers=2, heads=2, ffn=64),
)


def hf_model(tied: bool = False) -> Any:
    """The same network by transformers; every weight, bias and norm is random."""
    # Imported here: it takes seconds, and every worker imports this module to collect its tests.
    from transformers import InternVLForConditionalGeneration

    config = internvl_config(CONFIG, tied=tied)
    model = InternVLForConditionalGeneration(config).eval()
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            centre = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            parameter.normal_(centre, 0.3, generator=generator)
    return model


RENAMED = [
    (r"model\.vision_tower\.embeddings\.cls_token", "vision_model.embeddings.class_embedding"),
    (r"model\.vision_tower\.embeddings\.position_embeddings", "vision_model.embeddings.position_embedding"),
    (r"model\.vision_tower\.embeddings\.patch_embeddings\.projection", "vision_model.embeddings.patch_embedding"),
    (r"model\.vision_tower\.encoder\.layer\.(\d+)\.", r"vision_model.encoder.layers.\1."),
    (r"lambda_(\d)", r"ls\1"),
    (r"layernorm_before", "norm1"),
    (r"layernorm_after", "norm2"),
    (r"attention\.projection_layer", "attn.proj"),
    (r"model\.multi_modal_projector\.layer_norm", "mlp1.0"),
    (r"model\.multi_modal_projector\.linear_1", "mlp1.1"),
    (r"model\.multi_modal_projector\.linear_2", "mlp1.3"),
    (r"model\.language_model\.", "language_model.model."),
    (r"lm_head", "language_model.lm_head"),
]


def original_tensors(model: Any) -> dict[str, Tensor]:
    """OpenGVLab's names: renamed, and q, k and v of the encoder in one matrix."""
    tensors: dict[str, Tensor] = {}
    state = model.state_dict()
    for name, tensor in state.items():
        if ".attention.k_proj" in name or ".attention.v_proj" in name:
            continue
        if ".attention.q_proj" in name:
            tensor = torch.cat([state[name.replace("q_proj", f"{x}_proj")] for x in "qkv"])
            name = name.replace("attention.q_proj", "attn.qkv")
        for pattern, replacement in RENAMED:
            name = re.sub(pattern, replacement, name)
        tensors[name] = tensor.contiguous()
    return tensors


def original_config() -> dict[str, Any]:
    """config.json as OpenGVLab writes it."""
    vision, language = CONFIG.vision, CONFIG.language
    return {
        "architectures": ["InternVLChatModel"],
        "model_type": "internvl_chat",
        "downsample_ratio": 0.5,
        "ps_version": "v2",
        "select_layer": -1,
        "llm_config": {
            "architectures": ["Qwen2ForCausalLM"],
            "model_type": "qwen2",
            "hidden_act": "silu",
            "hidden_size": language.hidden,
            "num_hidden_layers": language.layers,
            "num_attention_heads": language.heads,
            "num_key_value_heads": language.kv_heads,
            "intermediate_size": language.mlp,
            "max_position_embeddings": 32768,
            "rms_norm_eps": 1e-6,
            "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"},
            "rope_theta": language.rope_theta,
            "use_sliding_window": False,
            "vocab_size": language.vocab,
            "tie_word_embeddings": False,
        },
        "vision_config": {
            "hidden_act": "gelu",
            "hidden_size": vision.hidden,
            "num_hidden_layers": vision.layers,
            "num_attention_heads": vision.heads,
            "intermediate_size": vision.mlp,
            "image_size": vision.image_px,
            "patch_size": vision.patch_px,
            "layer_norm_eps": 1e-6,
            "norm_type": "layer_norm",
            "qk_normalization": False,
            "qkv_bias": True,
            "num_channels": 3,
        },
    }


def write_directory(directory: Path, tensors: dict[str, Tensor]) -> Path:
    """An InternVL directory in OpenGVLab's layout."""
    directory.mkdir()
    save_file(tensors, str(directory / "model.safetensors"))
    (directory / "config.json").write_text(json.dumps(original_config()), encoding="utf-8")
    return directory


def refusal(*paths: Path, fill_seed: int | None = 0) -> str:
    """The one line that a checkpoint is refused with."""
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(paths, CONFIG, fill_seed=fill_seed)
    line = str(caught.value)
    assert "\n" not in line
    return line
