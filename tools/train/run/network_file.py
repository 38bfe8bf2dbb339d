"""The network between stages: each begins with the weights of the one before it and leaves its own."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open

from export.checkpoint.load import load_checkpoint
from export.model.config import ActionConfig, ModelConfigError, TicVlaConfig
from export.model.config_file import config_from_dict
from export.model.network import PARTS, TicVla, build
from export.model.weights import WeightsInfo, save_weights
from tools.train.drives.drive import file_sha256
from tools.train.run.job import StageJob

START: Final = "start"
"""Folder of weights that were there before the first stage."""
START_CARD: Final = "card.md"
"""Beside them: the model card that they had."""
CARD: Final = "MODEL_CARD.md"
"""Of a run, beside its weights."""
ORDER: Final = (START, "encoder", "sft", "imitate", "rl")
"""Where weights come from, in the order in which they do."""
FILE: Final = "model.safetensors"
SHARED: Final = ("vision", "language")
"""What ablations of the action expert have in common."""


class NetworkFileError(ValueError):
    """Weights that a stage cannot begin with; one line: what, expected, found."""


def stage_weights(out: Path, stage: str) -> Path:
    """Where a stage of the run in `out` leaves the whole network."""
    return out / stage / FILE


def weights_before(out: Path, stage: str) -> Path | None:
    """The newest weights of what comes before `stage`; None where there are none."""
    earlier = ORDER[: ORDER.index(stage)] if stage in ORDER else ORDER
    return next((path for name in reversed(earlier) if (path := stage_weights(out, name)).is_file()), None)


def import_start(out: Path, config: TicVlaConfig, checkpoints: Sequence[Path], seed: int) -> Path:
    """Begin a run with somebody's weights; an action expert that they lack is of the seed. Raises CheckpointError.

    An ablation of what the action expert hears goes on from weights of ours that heard it, and the other way round.
    """
    path = stage_weights(out, START)
    loaded = load_checkpoint(checkpoints, _as_written(checkpoints, config), fill_seed=seed)
    save_weights(loaded.model, path, WeightsInfo(trained=loaded.info.trained, origin=loaded.info.origin))
    if len(checkpoints) == 1 and (card := card_of(checkpoints[0])) is not None:
        path.with_name(START_CARD).write_text(card, encoding="utf-8")
    return path


def _as_written(checkpoints: Sequence[Path], config: TicVlaConfig) -> TicVlaConfig:
    """The configuration; where a file of ours differs only in what its action expert hears, that one's."""
    for path in checkpoints:
        try:
            with safe_open(str(path), framework="pt") as file:
                found = config_from_dict(json.loads((file.metadata() or {})["config"])).action
        except (OSError, SafetensorError, KeyError, ValueError, ModelConfigError):
            continue  # not of ours; the one who loads it says what is wrong with it
        if _hearing(found) == _hearing(config.action):
            return replace(config, action=found)
    return config


def _hearing(action: ActionConfig) -> ActionConfig:
    """An action expert that is told all: what it is not told reaches the same tensors as zeros."""
    return replace(action, latency_aware=True, motion_offset=True)


def card_of(weights: Path) -> str | None:
    """The model card beside weights of ours: the one that states this very file's hash; None where there is none."""
    if not weights.is_file():
        return None
    digest = file_sha256(weights)
    for path in (weights.with_suffix(".md"), weights.with_name(CARD)):
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            continue
        if f"SHA-256 `{digest}`" in text:
            return text
    return None


def is_trained(weights: Path) -> bool:
    """Whether all of the network in a file of ours has been trained. Raises NetworkFileError."""
    try:
        with safe_open(str(weights), framework="pt") as file:
            return (file.metadata() or {}).get("trained") == "true"
    except (OSError, SafetensorError) as error:
        raise NetworkFileError(f"{weights}: not weights of ours ({error})") from error


def start_network(job: StageJob, stage: str) -> TicVla:
    """The network that a stage begins with: of the stages before it, else of the recipe's seed; on the CPU.

    Raises NetworkFileError for weights of another network.
    """
    path = weights_before(job.run_dir.out, stage)
    if path is None:
        return build(job.recipe.model, job.recipe.seed)
    return read_network(path, job.recipe.model, job.recipe.seed)


def read_network(path: Path, config: TicVlaConfig, seed: int) -> TicVla:
    """A network from a file of ours. An action expert or value network of other numbers begins from the seed.

    What an action expert hears is no such number: ablations of it begin with the same weights as the whole.

    Raises NetworkFileError where encoder or language model are others.
    """
    model = build(config, seed)
    try:
        with safe_open(str(path), framework="pt") as file:
            found = config_from_dict(json.loads((file.metadata() or {})["config"]))
            theirs, ours = (replace(of, action=_hearing(of.action)) for of in (found, config))
            same = [part for part in PARTS if getattr(theirs, part) == getattr(ours, part)]
            if other := sorted(set(SHARED) - set(same)):
                raise NetworkFileError(f"{path}: its {other[0]} is not the recipe's; train from the beginning")
            tensors = {name: file.get_tensor(name) for name in file.keys() if name.split(".")[0] in same}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, ValueError, ModelConfigError) as error:
        if isinstance(error, NetworkFileError):
            raise
        raise NetworkFileError(f"{path}: not weights of ours ({error})") from error
    wanted = {name for name in model.state_dict() if name.split(".")[0] in same}
    if set(tensors) != wanted:
        odd = sorted(set(tensors) ^ wanted)
        raise NetworkFileError(f"{path}: expected the tensors of {', '.join(same)}; {odd[0]} is missing or unknown")
    model.load_state_dict(tensors, strict=False)
    return model


def finish_network(job: StageJob, stage: str, model: TicVla) -> Path:
    """Leave the network as this stage's, and as the run's `model.safetensors`; call it on the first rank only."""
    path = stage_weights(job.run_dir.out, stage)
    origin = f"edge-train {job.recipe.name}, seed {job.recipe.seed}, after {stage}"
    save_weights(model, path, WeightsInfo(trained=True, origin=origin))
    partial = job.run_dir.model_path.with_suffix(".partial")
    shutil.copyfile(path, partial)
    partial.replace(job.run_dir.model_path)
    return path
