"""Loads checkpoints into the network: finds layouts, accounts for every tensor, then reads them one by one as fp32."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from export.checkpoint.hf_config import check_config
from export.checkpoint.layouts import find_layouts
from export.checkpoint.sources import Source, open_source
from export.checkpoint.tokenizer import directory_tokenizer
from export.core.cache import file_sha256
from export.model.config import TicVlaConfig, config_from_dict
from export.model.network import TicVla, empty_network, initialise
from export.model.weights import FORMAT, CheckpointError, WeightsInfo

SHIPPED: Final = Path(__file__).parents[1] / "weights"
"""Trained weights in the package."""
SHOWN = 3
EMBED, LM_HEAD = "language.embed.weight", "language.lm_head.weight"
VALUE_SEED = 0
"""Seed of a value network that no file has; no graph uses it, only training does."""


@dataclass(frozen=True)
class SourceCoverage:
    """How the tensors of one `--checkpoint` were read."""

    label: str
    layouts: tuple[str, ...]
    """Layouts found, each with its tensors' prefix ("internvl, prefix vlm.")."""
    tensors: int
    loaded: int
    ignored: tuple[str, ...] = ()
    """Tensors without weights (buffers computed from the configuration)."""
    outside: tuple[str, ...] = ()
    """Other entries that were not read, such as optimizer state."""


@dataclass(frozen=True)
class Coverage:
    """Account of every tensor of the files and of the network."""

    sources: tuple[SourceCoverage, ...] = ()
    loaded: dict[str, str] = field(default_factory=dict)
    """Tensor of the network → "file: tensor[, tensor …]" it was read from."""
    seeded: dict[str, int] = field(default_factory=dict)
    """Part of the network that no file has → the seed of its random weights."""
    missing: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    misshaped: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether no tensor is missing, unknown, duplicate or of a wrong shape."""
        return not (self.missing or self.unknown or self.misshaped or self.repeated)

    def difference(self) -> str:
        """Return the differences in one line: a count and the first names of each kind."""
        kinds = {
            "missing": self.missing,
            "unknown": self.unknown,
            "of another shape": self.misshaped,
            "given twice": self.repeated,
        }
        return "; ".join(
            f"{len(names)} tensor{'s'[: len(names) != 1]} {kind} ({', '.join(names[:SHOWN])}"
            f"{', …' if len(names) > SHOWN else ''})"
            for kind, names in kinds.items()
            if names
        )


@dataclass(frozen=True)
class LoadedCheckpoint:
    """Loaded network and the origin of its weights."""

    model: TicVla
    info: WeightsInfo
    coverage: Coverage
    tokenizer: bytes | None
    """tokenizer.json of the Hugging Face directory, checked against the configuration's token ids."""


@dataclass
class _Plan:
    """Tensors found in the files, before any is read."""

    recipes: dict[str, tuple[Source, tuple[str, ...]]] = field(default_factory=dict)
    """Our tensor → the file and the names of the pieces there, which are stacked along the first axis."""
    sources: list[SourceCoverage] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    repeated: list[str] = field(default_factory=list)


def _describe(source: Source, names: tuple[str, ...]) -> str:
    return f"{source.label}: {', '.join(names)}"


def load_checkpoint(paths: Sequence[Path], config: TicVlaConfig, *, fill_seed: int | None) -> LoadedCheckpoint:
    """Load `config`'s network from checkpoints; raises CheckpointError unless every tensor is accounted for.

    `fill_seed` is for benchmarks: an action expert that no file has gets the seed's weights, and `info.trained` is
    False. Peak memory is the fp32 network and the largest single tensor.
    """
    if not paths:
        raise CheckpointError("no checkpoint given; expected at least one --checkpoint PATH")
    sources = [open_source(path) for path in paths]
    tied = False
    for source in sources:
        _check_own_config(source, config)
        if source.directory is not None:
            tied = check_config(source.directory, config).tied or tied
    model = empty_network(config)
    wanted = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    plan = _plan(sources, wanted, config)
    if tied and LM_HEAD not in plan.recipes and EMBED in plan.recipes:
        plan.recipes[LM_HEAD] = plan.recipes[EMBED]
    coverage = _account(plan, wanted, fill_seed)
    if not coverage.complete:
        _refuse(coverage, config, sources)
    _read(model, plan)
    for part, seed in coverage.seeded.items():
        initialise(model, seed, (part,))
    contents = (directory_tokenizer(s.directory, config.language) for s in sources if s.directory is not None)
    tokenizer = next((content for content in contents if content is not None), None)
    return LoadedCheckpoint(model, _info(sources, coverage), coverage, tokenizer)


def _check_own_config(source: Source, config: TicVlaConfig) -> None:
    """Refuse a file of this project whose recorded configuration differs, even if all shapes fit."""
    written = source.metadata.get("format", "")
    if written.split("/")[0] != FORMAT.split("/")[0]:
        return
    if written != FORMAT:
        raise CheckpointError(f"{source.label}: format {written!r}, expected {FORMAT!r}")
    try:
        # An older file lacks a newer number: its default is the behaviour before the number existed.
        theirs, ours = asdict(config_from_dict(json.loads(source.metadata["config"]))), asdict(config)
        differ = [
            f"{section}.{key} is {theirs[section][key]!r}, expected {value!r}"
            for section in ("vision", "language", "action", "value")
            for key, value in ours[section].items()
            if theirs[section][key] != value
        ]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(
            f"{source.label}: its configuration cannot be read; expected an unchanged file of edge-train or edge-export"
        ) from error
    if differ:
        raise CheckpointError(
            f"{source.label}: has another configuration than model {config.name!r} ({'; '.join(differ[:3])})"
        )


def _plan(sources: Sequence[Source], wanted: dict[str, tuple[int, ...]], config: TicVlaConfig) -> _Plan:
    plan = _Plan()
    for source in sources:
        matches = find_layouts(source.tensors, wanted, config)
        if not matches:
            names = ", ".join(list(source.tensors)[:3]) or "no tensors"
            raise CheckpointError(
                f"{source.label}: tensors of no layout that is known ({names}); expected InternVL, InternVL-hf or "
                f"{FORMAT} names"
            )
        used: set[str] = set()
        for match in matches:
            for ours, theirs in match.table.items():
                if not any(name in source.tensors for name in theirs):
                    continue
                used.update(theirs)
                if ours in plan.recipes:
                    plan.repeated.append(f"{ours} in {plan.recipes[ours][0].label} and {source.label}")
                else:
                    plan.recipes[ours] = (source, theirs)
        rest = [name for name in source.tensors if name not in used]
        patterns = [pattern for match in matches for pattern in match.ignored]
        ignored = tuple(name for name in rest if any(re.fullmatch(pattern, name) for pattern in patterns))
        plan.unknown += [f"{source.label}: {name}" for name in rest if name not in ignored]
        plan.sources.append(
            SourceCoverage(
                label=source.label,
                layouts=tuple(match.describe() for match in matches),
                tensors=len(source.tensors),
                loaded=sum(name in source.tensors for name in used),
                ignored=ignored,
                outside=source.outside,
            )
        )
    return plan


def _account(plan: _Plan, wanted: dict[str, tuple[int, ...]], fill_seed: int | None) -> Coverage:
    given = {name.split(".")[0] for name in plan.recipes}
    seeded = {}
    action_seed = None if "action" in given else fill_seed
    if "value" not in given:
        seeded["value"] = VALUE_SEED if action_seed is None else action_seed
    if action_seed is not None:
        seeded["action"] = action_seed
    missing, misshaped = [], []
    for name, shape in wanted.items():
        if name.split(".")[0] in seeded:
            continue
        recipe = plan.recipes.get(name)
        if recipe is None:
            missing.append(name)
            continue
        source, pieces = recipe
        missing += [f"{source.label}: {piece}" for piece in pieces if piece not in source.tensors]
        expected = (shape[0] // len(pieces), *shape[1:]) if len(pieces) > 1 else shape
        found = {piece: source.tensors[piece].shape for piece in pieces if piece in source.tensors}
        misshaped += [f"{p} is {list(s)}, expected {list(expected)}" for p, s in found.items() if s != expected]
    return Coverage(
        sources=tuple(plan.sources),
        loaded={name: _describe(*recipe) for name, recipe in plan.recipes.items()},
        seeded=seeded,
        missing=tuple(missing),
        unknown=tuple(plan.unknown),
        misshaped=tuple(misshaped),
        repeated=tuple(plan.repeated),
    )


def _refuse(coverage: Coverage, config: TicVlaConfig, sources: Sequence[Source]) -> None:
    labels = ", ".join(source.label for source in sources)
    absent = [part for part in ("vision", "language", "action") if not any(n.startswith(part) for n in coverage.loaded)]
    only_parts = not (coverage.unknown or coverage.misshaped or coverage.repeated) and all(
        name.split(".")[0] in absent for name in coverage.missing
    )
    if only_parts:
        names = {"vision": "vision encoder", "language": "language model", "action": "action expert"}
        hint = "add the file that has it as another --checkpoint"
        if absent == ["action"]:
            hint += ", or ask for untrained weights with --random-weights SEED"
        parts = " and no ".join(names[part] for part in absent)
        raise CheckpointError(f"{labels}: no {parts} ({len(coverage.missing)} tensors); {hint}")
    raise CheckpointError(f"{labels}: not the network of model {config.name!r}: {coverage.difference()}")


def _read(model: TicVla, plan: _Plan) -> None:
    targets = model.state_dict()
    for ours, (source, pieces) in plan.recipes.items():
        target: Tensor = targets[ours]
        # bf16 and fp16 convert to fp32 exactly; the copy also makes the network independent of the file.
        for part, piece in zip(target.chunk(len(pieces)) if len(pieces) > 1 else [target], pieces, strict=True):
            part.copy_(source.tensors[piece].read())
        if not torch.isfinite(target).all():
            raise CheckpointError(f"{_describe(source, pieces)}: has values that are not finite; the file is damaged")


def _info(sources: Sequence[Source], coverage: Coverage) -> WeightsInfo:
    """Return the origin by file name and hash; untrained if a file's metadata or a seed makes it so."""
    parts = []
    for source in sources:
        origin = source.metadata.get("origin", "")
        suffix = f", {origin}" if origin else ""
        parts += [f"{label} (sha256 {file_sha256(path)}{suffix})" for label, path in source.files.items()]
    parts += [f"{part}: random seed {seed}" for part, seed in coverage.seeded.items()]
    untrained = "action" in coverage.seeded or any(s.metadata.get("trained") == "false" for s in sources)
    return WeightsInfo(trained=not untrained, origin="; ".join(parts))


def shipped_weights(config: TicVlaConfig, folder: Path = SHIPPED) -> Path | None:
    """Return the shipped weights for exactly this network, or None. Raises CheckpointError if they cannot be read.

    A preset with changed numbers (`--set model.…`) has no shipped weights.
    """
    path = folder / f"{config.name}.safetensors"
    if not path.is_file():
        return None
    try:
        with safe_open(str(path), framework="pt") as file:
            written = config_from_dict(json.loads((file.metadata() or {})["config"]))
        return path if written == config else None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: the shipped weights cannot be read ({error}); install the package again"
        ) from error
