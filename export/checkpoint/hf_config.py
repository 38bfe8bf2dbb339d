"""Reads an InternVL directory's config.json in both of its layouts; refuses values that the network does not implement.

Layouts: OpenGVLab's own (`InternVLChatModel`, with `llm_config`) and that of transformers
(`InternVLForConditionalGeneration`, with `text_config`). A key that is absent has the default of the class that wrote
the file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from export.checkpoint.sources import read_json
from export.model.config import LanguageConfig, ModelConfigError, TicVlaConfig, VisionConfig
from export.model.weights import CheckpointError

CONFIG = "config.json"
PREPROCESSOR = "preprocessor_config.json"
N = TypeVar("N", int, float)

Demand = tuple[str, tuple[Any, ...], Any]
"""Key, implemented values, default of an absent key."""

_CHAT = (
    ("ps_version", ("v2",), "v1"),
    ("select_layer", (-1,), -1),
    ("use_llm_lora", (0,), 0),
    ("use_backbone_lora", (0,), 0),
)
_CHAT_VISION = (
    ("hidden_act", ("gelu",), "gelu"),
    ("norm_type", ("layer_norm",), "rms_norm"),
    ("qk_normalization", (False,), True),
    ("qkv_bias", (True,), False),
    ("num_channels", (3,), 3),
)
_HF = (
    ("vision_feature_layer", (-1,), -1),
    ("vision_feature_select_strategy", ("default",), "default"),
    ("projector_hidden_act", ("gelu",), "gelu"),
)
_HF_VISION = (
    ("hidden_act", ("gelu",), "gelu"),
    ("norm_type", ("layer_norm",), "layer_norm"),
    ("use_qk_norm", (False,), False),
    ("attention_bias", (True,), False),
    ("use_mask_token", (False,), False),
    ("use_absolute_position_embeddings", (True,), False),
    ("use_mean_pooling", (True,), True),
    ("num_channels", (3,), 3),
)
_QWEN2 = (
    ("model_type", ("qwen2",), "qwen2"),
    ("hidden_act", ("silu",), "silu"),
    ("use_sliding_window", (False,), False),
)
_ROPE_TYPES = ("default", "dynamic")
_KINDS: Mapping[type, str] = {int: "a whole number", float: "a finite number"}
_HF_VISION_DEFAULTS = {
    "hidden_size": 1024,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "intermediate_size": 4096,
    "image_size": 448,
    "patch_size": 14,
}


@dataclass(frozen=True)
class HfConfig:
    """Network configuration read from a directory."""

    vision: VisionConfig
    language: LanguageConfig
    tied: bool
    """The output head is the embedding: a file without a head is complete."""


@dataclass(frozen=True)
class _Section:
    """Table of config.json; errors name a key by its full path."""

    where: str
    content: Mapping[str, Any]
    defaults: Mapping[str, int] = field(default_factory=dict)

    def below(
        self, key: str, called: str, demands: tuple[Demand, ...], defaults: Mapping[str, int] | None = None
    ) -> _Section:
        """Return a nested section that records its demands in the same list."""
        section = self.content.get(key)
        if not isinstance(section, dict):
            raise CheckpointError(f"{self.where}has no {key}")
        found = _Section(f"{self.where}{called}.", section, defaults or {})
        found.demand(demands)
        return found

    def demand(self, demands: tuple[Demand, ...]) -> None:
        """Refuse a value that this network does not implement."""
        for key, accepted, default in demands:
            value = self.content.get(key, default)
            if value not in accepted:
                expected = " or ".join(repr(a) for a in accepted)
                raise CheckpointError(f"{self.where}{key} is {value!r}, this network implements {expected}")

    def number(self, key: str, kind: type[N], default: object = None) -> N:
        """Return a finite number; for a [side, side] pair of a square, one of both."""
        value = self.content.get(key, self.defaults.get(key, default))
        if isinstance(value, list) and len(value) == 2 and value[0] == value[1]:
            value = value[0]
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool) or not math.isfinite(value):
            found = "not there" if value is None else repr(value)
            raise CheckpointError(f"{self.where}{key} is {found}, expected {_KINDS[kind]}")
        return value

    def table(self, key: str) -> Mapping[str, Any]:
        """Return a nested table without a section of its own; an absent or null one is empty."""
        value = self.content.get(key)
        if value is not None and not isinstance(value, dict):
            raise CheckpointError(f"{self.where}{key} is {value!r}, expected an object")
        return value or {}


def read_hf_config(directory: Path, ours: LanguageConfig) -> HfConfig:
    """Read config.json in either layout; `ours` supplies values that it lacks (token ids, `max_context`).

    Raises CheckpointError that names a value which this network does not implement.
    """
    content = read_json(directory, CONFIG)
    where = f"{directory.resolve().name}/{CONFIG}"
    top = _Section(f"{where}: ", content)
    try:
        if "llm_config" in content:
            top.demand(_CHAT)
            vision = top.below("vision_config", "vision_config", _CHAT_VISION)
            return _read(top, directory, ours, vision, top.below("llm_config", "text_config", _QWEN2))
        if "text_config" in content:
            top.demand(_HF)
            vision = top.below("vision_config", "vision_config", _HF_VISION, _HF_VISION_DEFAULTS)
            image_id = top.number("image_token_id", int, 151667)
            ours = dataclasses.replace(ours, img_context_id=image_id) if image_id != ours.img_context_id else ours
            return _read(top, directory, ours, vision, top.below("text_config", "text_config", _QWEN2))
    except (ModelConfigError, OverflowError) as error:
        raise CheckpointError(f"{where}: {error}") from error
    found = content.get("model_type", content.get("architectures", "neither"))
    raise CheckpointError(f"{where}: expected InternVL's llm_config or text_config; found {found!r}")


def check_config(directory: Path, config: TicVlaConfig) -> HfConfig:
    """Refuse a directory whose config.json contradicts `config`; raises CheckpointError naming the numbers."""
    theirs = read_hf_config(directory, config.language)
    pairs = []
    for section in ("vision", "language"):
        for key, b in vars(getattr(config, section)).items():
            a = getattr(getattr(theirs, section), key)
            # Loaded weights overwrite the layer scale's initial value, so it is not compared.
            if a != b and key != "layer_scale_init":
                pairs.append(f"{section}.{key} is {a}, model {config.name!r} has {b}")
    if pairs:
        more = f" and {len(pairs) - 3} more" if len(pairs) > 3 else ""
        raise CheckpointError(
            f"{directory.resolve().name}/{CONFIG}: {'; '.join(pairs[:3])}{more}: "
            "choose the --model this checkpoint was made for"
        )
    return theirs


def _read(top: _Section, directory: Path, ours: LanguageConfig, vision: _Section, text: _Section) -> HfConfig:
    content = text.content
    layer_types = content.get("layer_types") or []
    if not isinstance(layer_types, list) or any(kind != "full_attention" for kind in layer_types):
        raise CheckpointError(f"{text.where}layer_types is {layer_types!r}, only full_attention is implemented")
    head_dim = content.get("head_dim")
    hidden, heads = (text.number(key, int) for key in ("hidden_size", "num_attention_heads"))
    language = dataclasses.replace(
        ours,
        hidden=hidden,
        layers=text.number("num_hidden_layers", int),
        heads=heads,
        kv_heads=text.number("num_key_value_heads", int),
        head_dim=head_dim if isinstance(head_dim, int) else hidden // max(heads, 1),
        mlp=text.number("intermediate_size", int),
        vocab=text.number("vocab_size", int),
        rope_theta=_rope_theta(text, ours.max_context),
        rms_eps=text.number("rms_norm_eps", float, 1e-6),
        token_merge=1,
    )
    # By default transformers ties InternVL's head and OpenGVLab's Qwen2 does not.
    tied = top.content.get("tie_word_embeddings", content.get("tie_word_embeddings", "text_config" in top.content))
    ratio = top.number("downsample_ratio", float, 0.5)
    if ratio <= 0 or (1 / ratio) != round(1 / ratio):
        raise CheckpointError(f"{top.where}downsample_ratio is {ratio}, expected one over a whole number")
    mean, std = _normalisation(directory)
    encoder = VisionConfig(
        image_px=vision.number("image_size", int),
        patch_px=vision.number("patch_size", int),
        hidden=vision.number("hidden_size", int),
        layers=vision.number("num_hidden_layers", int),
        heads=vision.number("num_attention_heads", int),
        mlp=vision.number("intermediate_size", int),
        layer_norm_eps=vision.number("layer_norm_eps", float, 1e-6),
        pixel_shuffle=round(1 / ratio),
        token_dim=hidden,
        mean=mean,
        std=std,
    )
    return HfConfig(encoder, language, bool(tied))


def _normalisation(directory: Path) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the pixels' mean and deviation from preprocessor_config.json, else ImageNet's."""
    if not (directory / PREPROCESSOR).exists():
        return VisionConfig.mean, VisionConfig.std
    content = read_json(directory, PREPROCESSOR)
    found = []
    for key, default in (("image_mean", VisionConfig.mean), ("image_std", VisionConfig.std)):
        value = content.get(key, list(default))
        if not isinstance(value, list) or len(value) != 3 or not all(isinstance(v, float | int) for v in value):
            raise CheckpointError(f"{directory.resolve().name}/{PREPROCESSOR}: {key} is {value!r}, expected 3 numbers")
        found.append((float(value[0]), float(value[1]), float(value[2])))
    return found[0], found[1]


def _rope_theta(text: _Section, max_context: int) -> float:
    """Return the rotary angles' base; newer files have it in `rope_parameters`, older ones beside `rope_scaling`."""
    parameters = text.table("rope_parameters")
    scaling = text.table("rope_scaling") or parameters
    kind = scaling.get("rope_type", scaling.get("type", "default"))
    if kind not in _ROPE_TYPES:
        raise CheckpointError(f"{text.where}rope_scaling of type {kind!r} is not implemented, expected {_ROPE_TYPES}")
    # Dynamic scaling changes only sequences beyond the trained length; the runner's prompts are shorter.
    trained = text.number("max_position_embeddings", int, 32768)
    if trained < max_context:
        raise CheckpointError(f"{text.where}max_position_embeddings is {trained}, the model reads {max_context}")
    source = dataclasses.replace(text, content=parameters) if "rope_theta" in parameters else text
    return source.number("rope_theta", float, 10000.0)
