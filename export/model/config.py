"""Every number of the TIC-VLA network in one frozen dataclass; presets `1b` (paper size) and `nano` (ours).

A network is named by a preset, a JSON file or `section.field=value` overrides.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge.state.reasoning_text import WAYPOINT_TIMES_S
from export.core.typed import FieldError, SettingText, build, field_types, near
from firmware_bridge.system.input_file import read_json

SEMANTIC_INTERFACES = ("kv", "values-only", "waypoints")
"""Part of a generation that the action expert receives: last-layer K‖V, V alone, or waypoints (paper Table 2)."""
PARAMETERISATIONS = ("increments", "offsets")
HEADS = ("query", "diffusion", "flow")
"""Heads of the action expert (paper Table 11): read from the queries, denoised, or mapped from a Gaussian."""
OF_HEADS = ("head", "diffusion_steps", "ddim_steps", "couplings")
"""Fields of the action expert that only generative heads use; older files lack them."""
MODEL_PREFIX = "model."
"""Prefix of a `--set` that changes the network instead of the target."""
MAX_CONFIG_BYTES = 1 << 20


class ModelConfigError(ValueError):
    """Invalid model configuration."""


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise ModelConfigError(message)


def _require_sizes(config: object) -> None:
    """Check that sizes and counts are 1 to 2^20: a larger one is a typing error."""
    for key, value in vars(config).items():
        for size in value if isinstance(value, tuple) else (value,):
            if isinstance(size, int) and not isinstance(size, bool) and not key.endswith("_id"):
                _require(1 <= size <= 1 << 20, f"{key} is {size}, expected 1 to {1 << 20}")
            elif key.endswith("eps") or key in ("step_s", "rope_theta"):
                _require(size > 0, f"{key} is {size}, expected a number above 0")


@dataclass(frozen=True)
class VisionConfig:
    """InternViT-style encoder and its projector (defaults are InternViT-300M)."""

    image_px: int = 448
    patch_px: int = 14
    stem_channels: tuple[int, ...] = ()
    """Channels of stride-2 3×3 convolutions before the embedding; empty: one patch×patch convolution."""
    hidden: int = 1024
    layers: int = 24
    heads: int = 16
    mlp: int = 4096
    layer_norm_eps: float = 1e-6
    layer_scale_init: float = 0.1
    pixel_shuffle: int = 2
    """Side of the patch square folded into one visual token (2 is InternVL's ×0.5)."""
    projector_eps: float = 1e-5
    token_dim: int = 896
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)

    def __post_init__(self) -> None:
        _require_sizes(self)
        _require(self.image_px % self.patch_px == 0, f"image_px {self.image_px} is not a multiple of {self.patch_px}")
        _require(self.grid % self.pixel_shuffle == 0, f"grid {self.grid} is not a multiple of {self.pixel_shuffle}")
        _require(self.hidden % self.heads == 0, f"hidden {self.hidden} is not a multiple of heads {self.heads}")
        _require(
            not self.stem_channels or self.patch_px == 2 ** len(self.stem_channels),
            f"{len(self.stem_channels)} stride-2 stem layers do not make patch_px {self.patch_px}",
        )

    @property
    def grid(self) -> int:
        """Patches along one side."""
        return self.image_px // self.patch_px

    @property
    def tokens(self) -> int:
        """Visual tokens of one frame."""
        return (self.grid // self.pixel_shuffle) ** 2


@dataclass(frozen=True)
class LanguageConfig:
    """Qwen2.5-style decoder (defaults are Qwen2.5-0.5B as in InternVL3-1B)."""

    hidden: int = 896
    layers: int = 24
    heads: int = 14
    kv_heads: int = 2
    head_dim: int = 64
    mlp: int = 4864
    vocab: int = 151674
    rope_theta: float = 1e6
    rms_eps: float = 1e-6
    token_merge: int = 1
    """Side of the square of visual tokens that are merged into one language token (1: no merging, as in the paper)."""
    max_context: int = 1536
    im_start_id: int = 151644
    im_end_id: int = 151645
    img_start_id: int = 151665
    img_end_id: int = 151666
    img_context_id: int = 151667

    def __post_init__(self) -> None:
        _require_sizes(self)
        _require(self.heads % self.kv_heads == 0, f"heads {self.heads} is not a multiple of kv_heads {self.kv_heads}")
        ids = (self.im_start_id, self.im_end_id, self.img_start_id, self.img_end_id, self.img_context_id)
        _require(
            len(set(ids)) == 5 and min(ids) >= 0 and max(ids) < self.vocab,
            f"special ids {ids} must be distinct and below vocab {self.vocab}",
        )
        _require(self.head_dim % 2 == 0, f"head_dim {self.head_dim} must be even for rotary positions")


@dataclass(frozen=True)
class ActionConfig:
    """Action expert: cross-attention over visual tokens, delayed semantics, state and latency (paper Table 7)."""

    hidden: int = 512
    layers: int = 6
    heads: int = 8
    ffn: int = 2048
    steps: int = 30
    step_s: float = 0.1
    kv_dropout: float = 0.1
    state_dropout: float = 0.5
    semantic_interface: str = "kv"
    latency_aware: bool = True
    motion_offset: bool = True
    parameterisation: str = "increments"
    initial_step: tuple[float, float, float] = (0.05, 0.0, 0.0)
    """Initial bias of the head per step (dx m, dy m, dθ rad): 0.5 m/s straight ahead."""
    head: str = "query"
    diffusion_steps: int = 100
    """Noise levels of a diffusion in training."""
    ddim_steps: int = 5
    """Noise levels at inference, each a pass through all layers."""
    couplings: int = 5
    """Affine couplings of a flow."""

    def __post_init__(self) -> None:
        _require_sizes(self)
        _require(self.hidden % self.heads == 0, f"hidden {self.hidden} is not a multiple of heads {self.heads}")
        _require(
            self.semantic_interface in SEMANTIC_INTERFACES,
            f"semantic_interface {self.semantic_interface!r}: expected one of {SEMANTIC_INTERFACES}",
        )
        _require(
            self.parameterisation in PARAMETERISATIONS,
            f"parameterisation {self.parameterisation!r}: expected one of {PARAMETERISATIONS}",
        )
        _require(self.head in HEADS, f"head {self.head!r}: expected one of {HEADS}")
        _require(
            self.ddim_steps <= self.diffusion_steps,
            f"ddim_steps {self.ddim_steps} are more than the {self.diffusion_steps} of diffusion_steps",
        )
        _require(self.head != "diffusion" or self.hidden % 2 == 0, f"hidden {self.hidden} must be even for a diffusion")
        _require(self.head != "flow" or self.steps > 1, "steps is 1, expected two or more that a flow can split")
        for name in ("kv_dropout", "state_dropout"):
            _require(0 <= getattr(self, name) < 1, f"{name} must be in [0, 1)")


@dataclass(frozen=True)
class ValueConfig:
    """Value network of reinforcement learning (paper appendix A)."""

    channels: int = 256
    conv_layers: int = 3

    def __post_init__(self) -> None:
        _require_sizes(self)


@dataclass(frozen=True)
class TicVlaConfig:
    """The whole network."""

    name: str
    vision: VisionConfig = field(default_factory=VisionConfig)
    language: LanguageConfig = field(default_factory=LanguageConfig)
    action: ActionConfig = field(default_factory=ActionConfig)
    value: ValueConfig = field(default_factory=ValueConfig)

    def __post_init__(self) -> None:
        _require(bool(self.name), "name is empty, expected a name for this network")
        side = self.vision.grid // self.vision.pixel_shuffle
        _require(
            side % self.language.token_merge == 0, f"{side} tokens a side do not merge by {self.language.token_merge}"
        )
        _require(
            self.language.token_merge > 1 or self.vision.token_dim == self.language.hidden,
            f"token_dim {self.vision.token_dim} must equal the language model's hidden {self.language.hidden}",
        )

    @property
    def frame_tokens(self) -> int:
        """Language tokens of one frame."""
        return self.vision.tokens // self.language.token_merge**2

    @property
    def kv_dim(self) -> int:
        """Width of one token of the semantic state: last-layer K‖V (256 at paper size)."""
        return 2 * self.language.kv_heads * self.language.head_dim

    @property
    def guidance_width(self) -> int:
        """Width of one input token of the semantic context."""
        widths = {"kv": self.kv_dim, "values-only": self.kv_dim // 2, "waypoints": 2}
        return widths[self.action.semantic_interface]

    @property
    def guidance_tokens(self) -> int:
        """Largest number of input tokens of the semantic context."""
        by_text = self.action.semantic_interface == "waypoints"
        return len(WAYPOINT_TIMES_S) if by_text else self.language.max_context

    def to_dict(self) -> dict[str, Any]:
        """Return the plain JSON form; a query head omits the other heads' fields, so that old files stay equal."""
        content = dataclasses.asdict(self)
        if self.action.head == "query":
            usual, action = ActionConfig(), content["action"]
            for key in OF_HEADS:
                if action[key] == getattr(usual, key):
                    del action[key]
        return content


PRESETS = {
    "1b": TicVlaConfig(name="1b"),
    "nano": TicVlaConfig(
        name="nano",
        vision=VisionConfig(
            image_px=128,
            patch_px=16,
            stem_channels=(24, 48, 96, 192),
            hidden=192,
            layers=4,
            heads=3,
            mlp=768,
            pixel_shuffle=1,
            token_dim=256,
        ),
        language=LanguageConfig(
            hidden=256,
            layers=4,
            heads=4,
            kv_heads=2,
            head_dim=64,
            mlp=688,
            vocab=1024,
            rope_theta=1e4,
            token_merge=2,
            max_context=512,
            im_start_id=1,
            im_end_id=2,
            img_start_id=3,
            img_end_id=4,
            img_context_id=5,
        ),
        action=ActionConfig(hidden=256, heads=4, ffn=1024),
        value=ValueConfig(channels=128),
    ),
}


def config_for(model: str) -> TicVlaConfig:
    """Load the configuration that `--model` names: a preset or a `.json` file. Raises ModelConfigError."""
    if model in PRESETS:
        return PRESETS[model]
    if model.endswith(".json"):
        return config_from_file(Path(model))
    raise ModelConfigError(
        f"model {model!r} is not known; expected one of: {', '.join(sorted(PRESETS))}, or a .json file"
    )


def config_from_file(path: Path) -> TicVlaConfig:
    """Read a TicVlaConfig in its `to_dict` form (absent fields keep their defaults); raises ModelConfigError."""
    try:
        content = read_json(path, MAX_CONFIG_BYTES)
    except OSError as error:
        raise ModelConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ModelConfigError(f"{path}: not JSON ({error})") from error
    return config_from_dict(content, str(path))


def config_from_dict(content: object, where: str = "model") -> TicVlaConfig:
    """Build a configuration from its `to_dict` form. Raises ModelConfigError for unknown keys and wrong types."""
    try:
        return build(TicVlaConfig, content, where)
    except FieldError as error:
        raise ModelConfigError(str(error)) from error


def model_settings(settings: Sequence[str]) -> dict[str, str]:
    """Return `section.field` → value of each `--set model.section.field=value`; ignores other settings."""
    pairs = [setting.partition("=") for setting in settings]
    return {
        key.strip().removeprefix(MODEL_PREFIX): value for key, _, value in pairs if key.strip().startswith(MODEL_PREFIX)
    }


def with_overrides(config: TicVlaConfig, overrides: Mapping[str, str]) -> TicVlaConfig:
    """Replace fields such as `action.layers` by values given as text. Raises ModelConfigError."""
    content = config.to_dict()
    sections = {key: kind for key, kind in field_types(TicVlaConfig).items() if key != "name"}
    names = [f"{section}.{key}" for section, cls in sections.items() for key in field_types(cls)]
    for key, text in overrides.items():
        if key not in names:
            raise ModelConfigError(f"model.{key} is not a number of the model; {near(key, names)}")
        section, name = key.split(".")
        content[section][name] = SettingText(text)
    return config_from_dict(content)
