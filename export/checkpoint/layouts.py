"""Checkpoint layouts as tables that map a file's tensors to the network's.

A rule is (network's name, file's names …). `{n}` is the layer number. Several file tensors are stacked along the first
axis (the encoder's q, k and v, which the network has in one matrix). Names in a table have no prefix: `PREFIXES` lists
the prefixes that training code adds.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from export.model.config import TicVlaConfig

PREFIXES = ("", "model.", "module.", "vlm.", "model.vlm.", "module.vlm.", "policy.", "model.policy.")
"""Plain; attribute of a Lightning module; DataParallel; a VLM or policy as attribute of either."""

Rule = tuple[str, ...]


@dataclass(frozen=True)
class Layout:
    """Naming scheme of the network's tensors."""

    name: str
    vision: tuple[Rule, ...]
    vision_layers: tuple[Rule, ...]
    language: tuple[Rule, ...]
    language_layers: tuple[Rule, ...]
    ignored: tuple[str, ...]
    """Patterns of tensors without weights: derived from the configuration, or used only in training."""

    def names(self, config: TicVlaConfig) -> dict[str, tuple[str, ...]]:
        """Return the network's tensor → the file's tensors, with every layer number filled in."""
        rules = [*self.vision, *self.language]
        for each, layers in (
            (self.vision_layers, config.vision.layers),
            (self.language_layers, config.language.layers),
        ):
            rules += [tuple(name.replace("{n}", str(n)) for name in rule) for n in range(layers) for rule in each]
        return {ours: tuple(theirs) for ours, *theirs in rules}


@dataclass(frozen=True)
class Match:
    """Layout found in a file: its table with the file's prefix."""

    layout: str
    prefix: str
    table: dict[str, tuple[str, ...]]
    ignored: tuple[str, ...]

    def describe(self) -> str:
        """Return layout and prefix for the report."""
        return f"{self.layout}, prefix {self.prefix}" if self.prefix else self.layout


def _both(ours: str, *theirs: str) -> tuple[Rule, ...]:
    return tuple((f"{ours}.{kind}", *(f"{name}.{kind}" for name in theirs)) for kind in ("weight", "bias"))


def _decoder(root: str) -> tuple[Rule, ...]:
    """Return Qwen2 layers as transformers names them, below `root`."""
    layer, ours = f"{root}.layers.{{n}}", "language.layers.{n}"
    return (
        *_both(f"{ours}.q", f"{layer}.self_attn.q_proj"),
        *_both(f"{ours}.k", f"{layer}.self_attn.k_proj"),
        *_both(f"{ours}.v", f"{layer}.self_attn.v_proj"),
        (f"{ours}.o.weight", f"{layer}.self_attn.o_proj.weight"),
        (f"{ours}.gate.weight", f"{layer}.mlp.gate_proj.weight"),
        (f"{ours}.up.weight", f"{layer}.mlp.up_proj.weight"),
        (f"{ours}.down.weight", f"{layer}.mlp.down_proj.weight"),
        (f"{ours}.input_norm.weight", f"{layer}.input_layernorm.weight"),
        (f"{ours}.mlp_norm.weight", f"{layer}.post_attention_layernorm.weight"),
    )


def _decoder_ends(root: str, lm_head: str) -> tuple[Rule, ...]:
    return (
        ("language.embed.weight", f"{root}.embed_tokens.weight"),
        ("language.norm.weight", f"{root}.norm.weight"),
        ("language.lm_head.weight", f"{lm_head}.weight"),
    )


def _hugging_face_vision(tower: str, projector: str) -> tuple[tuple[Rule, ...], tuple[Rule, ...]]:
    embeddings, layer, ours = f"{tower}.embeddings", f"{tower}.encoder.layer.{{n}}", "vision.blocks.{n}"
    whole = (
        ("vision.cls", f"{embeddings}.cls_token"),
        ("vision.position", f"{embeddings}.position_embeddings"),
        *_both("vision.embed", f"{embeddings}.patch_embeddings.projection"),
        *_both("vision.projector.0", f"{projector}.layer_norm"),
        *_both("vision.projector.1", f"{projector}.linear_1"),
        *_both("vision.projector.3", f"{projector}.linear_2"),
    )
    layers = (
        *_both(f"{ours}.norm1", f"{layer}.layernorm_before"),
        *_both(f"{ours}.qkv", *(f"{layer}.attention.{x}_proj" for x in "qkv")),
        *_both(f"{ours}.proj", f"{layer}.attention.projection_layer"),
        (f"{ours}.ls1", f"{layer}.lambda_1"),
        *_both(f"{ours}.norm2", f"{layer}.layernorm_after"),
        *_both(f"{ours}.fc1", f"{layer}.mlp.fc1"),
        *_both(f"{ours}.fc2", f"{layer}.mlp.fc2"),
        (f"{ours}.ls2", f"{layer}.lambda_2"),
    )
    return whole, layers


_INTERNVL_LAYER = "vision_model.encoder.layers.{n}"
_ROTARY = r"(model\.)?language_model\.(model\.)?(layers\.\d+\.self_attn\.)?rotary_emb\.(original_)?inv_freq"

INTERNVL = Layout(
    name="internvl",
    vision=(
        ("vision.cls", "vision_model.embeddings.class_embedding"),
        ("vision.position", "vision_model.embeddings.position_embedding"),
        *_both("vision.embed", "vision_model.embeddings.patch_embedding"),
        *_both("vision.projector.0", "mlp1.0"),
        *_both("vision.projector.1", "mlp1.1"),
        *_both("vision.projector.3", "mlp1.3"),
    ),
    vision_layers=(
        *_both("vision.blocks.{n}.norm1", f"{_INTERNVL_LAYER}.norm1"),
        *_both("vision.blocks.{n}.qkv", f"{_INTERNVL_LAYER}.attn.qkv"),
        *_both("vision.blocks.{n}.proj", f"{_INTERNVL_LAYER}.attn.proj"),
        ("vision.blocks.{n}.ls1", f"{_INTERNVL_LAYER}.ls1"),
        *_both("vision.blocks.{n}.norm2", f"{_INTERNVL_LAYER}.norm2"),
        *_both("vision.blocks.{n}.fc1", f"{_INTERNVL_LAYER}.mlp.fc1"),
        *_both("vision.blocks.{n}.fc2", f"{_INTERNVL_LAYER}.mlp.fc2"),
        ("vision.blocks.{n}.ls2", f"{_INTERNVL_LAYER}.ls2"),
    ),
    language=_decoder_ends("language_model.model", "language_model.lm_head"),
    language_layers=_decoder("language_model.model"),
    ignored=(_ROTARY, r"vision_model\.embeddings\.position_ids"),
)


def _hugging_face(name: str, tower: str, projector: str, decoder: str, lm_head: str) -> Layout:
    vision, vision_layers = _hugging_face_vision(tower, projector)
    return Layout(name, vision, vision_layers, _decoder_ends(decoder, lm_head), _decoder(decoder), (_ROTARY,))


INTERNVL_HF = _hugging_face(
    "internvl-hf", "vision_tower", "multi_modal_projector", "language_model.model", "language_model.lm_head"
)
"""Layout that `save_pretrained` writes."""

INTERNVL_HF_MODULES = _hugging_face(
    "internvl-hf modules",
    "model.vision_tower",
    "model.multi_modal_projector",
    "model.language_model",
    "lm_head",
)
"""Layout of the same model's `state_dict()`, as in training checkpoints."""

VLM_LAYOUTS = (INTERNVL, INTERNVL_HF, INTERNVL_HF_MODULES)


def find_layouts(names: Collection[str], ours: Collection[str], config: TicVlaConfig) -> list[Match]:
    """Return the layout of the VLM and that of action expert and value network, if the file has them.

    Each is the combination of layout and prefix that names most of the file's tensors; ties take the earlier one.
    Tensors that it does not name count as unknown, so the loader refuses a wrong choice.
    """
    vlm = {name: (name,) for name in ours if name.startswith(("vision.", "language."))}
    action = {name: (name,) for name in ours if name.startswith(("action.", "value."))}
    groups: list[list[tuple[str, Mapping[str, tuple[str, ...]], tuple[str, ...]]]] = [
        [("tic-vla-edge", vlm, ()), *((x.name, x.names(config), x.ignored) for x in VLM_LAYOUTS)],
        [("tic-vla-edge action", action, ())],
    ]
    present, found = set(names), []
    for group in groups:
        best, most = None, 0
        for layout, table, ignored in group:
            theirs = [name for sources in table.values() for name in sources]
            for prefix in PREFIXES:
                claimed = sum(prefix + name in present for name in theirs)
                if claimed > most:
                    most, best = claimed, (layout, prefix, table, ignored)
        if best is not None:
            layout, prefix, table, ignored = best
            prefixed = {ours_: tuple(prefix + name for name in sources) for ours_, sources in table.items()}
            found.append(Match(layout, prefix, prefixed, tuple(re.escape(prefix) + p for p in ignored)))
    return found
