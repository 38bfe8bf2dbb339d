"""Weights between stages, and their export: each stage starts with those of the previous one and writes its own."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open

from edge.artifacts.files import MANIFEST_NAME
from edge.core.cli import EXIT_DONE, EXIT_INTERRUPTED, write_whole
from export.checkpoint.load import load_checkpoint
from export.checkpoint.sources import open_source
from export.core.tensor_file import replacing
from export.model.config import PRESETS, ActionConfig, ModelConfigError, TicVlaConfig, config_from_dict
from export.model.network import PARTS, TicVla, build
from export.model.weights import WeightsInfo, save_weights
from sim_hil.processes.child_process import last_lines
from tools.train.config.checks import TrainError
from tools.train.drives.drive import file_sha256
from tools.train.run.job import StageJob
from tools.train.run.run_dir import read_record

START: Final = "start"
"""Folder of weights that the run started with."""
START_CARD: Final = "card.md"
"""Their model card, in the same folder."""
CARD: Final = "MODEL_CARD.md"
"""Model card of a run, beside its weights."""
ORDER: Final = (START, "encoder", "sft", "imitate", "rl")
"""Folders with weights, in the order of the stages."""
FILE: Final = "model.safetensors"
SHARED: Final = ("vision", "language")
"""Parts that ablations of the action expert share."""


def stage_weights(out: Path, stage: str) -> Path:
    """Return the path of a stage's weights in the run `out`."""
    return out / stage / FILE


def weights_before(out: Path, stage: str) -> Path | None:
    """Return the newest weights from before `stage`; None if there are none."""
    earlier = ORDER[: ORDER.index(stage)] if stage in ORDER else ORDER
    return next((path for name in reversed(earlier) if (path := stage_weights(out, name)).is_file()), None)


def import_start(out: Path, config: TicVlaConfig, checkpoints: Sequence[Path], seed: int) -> Path:
    """Convert given weights to the run's start weights; a missing action expert is initialised from the seed.

    Weights of edge-train with other inputs of the action expert (`latency_aware`, `motion_offset`) are accepted.
    Returns the path. Raises CheckpointError.
    """
    path = stage_weights(out, START)
    loaded = load_checkpoint(checkpoints, _as_written(checkpoints, config), fill_seed=seed)
    save_weights(loaded.model, path, WeightsInfo(trained=loaded.info.trained, origin=loaded.info.origin))
    if len(checkpoints) == 1 and (card := card_of(checkpoints[0])) is not None:
        path.with_name(START_CARD).write_text(card, encoding="utf-8")
    return path


def started_with(out: Path, checkpoints: Sequence[Path]) -> bool:
    """Return whether a run's start weights were made of these files, whose hashes their origin contains.

    Raises CheckpointError, or TrainError for damaged start weights.
    """
    path = stage_weights(out, START)
    try:
        with safe_open(str(path), framework="pt") as file:
            origin = (file.metadata() or {}).get("origin", "")
    except (OSError, SafetensorError) as error:
        raise TrainError(f"{path}: not weights of edge-train ({error})") from error
    files = [file for given in checkpoints for file in open_source(given).files.values()]
    return all(f"(sha256 {file_sha256(file)}" in origin for file in files)


def _as_written(checkpoints: Sequence[Path], config: TicVlaConfig) -> TicVlaConfig:
    """Return a file's configuration if it differs only in the action expert's inputs, else `config`."""
    for path in checkpoints:
        try:
            with safe_open(str(path), framework="pt") as file:
                found = config_from_dict(json.loads((file.metadata() or {})["config"])).action
        except (OSError, SafetensorError, KeyError, ValueError, ModelConfigError):
            continue  # another format; loading it reports what is wrong
        if _with_all_inputs(found) == _with_all_inputs(config.action):
            return replace(config, action=found)
    return config


def _with_all_inputs(action: ActionConfig) -> ActionConfig:
    """Enable all inputs of an action expert: a disabled input is a zero for the same tensors."""
    return replace(action, latency_aware=True, motion_offset=True)


def card_of(weights: Path) -> str | None:
    """Return the model card beside weights that states their hash; None if there is none."""
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
    """Return whether the whole network in a file was trained. Raises TrainError."""
    try:
        with safe_open(str(weights), framework="pt") as file:
            return (file.metadata() or {}).get("trained") == "true"
    except (OSError, SafetensorError) as error:
        raise TrainError(f"{weights}: not weights of edge-train ({error})") from error


def start_network(job: StageJob, stage: str) -> TicVla:
    """Load the network of the previous stage, or initialise one from the recipe's seed; on the CPU.

    Raises TrainError for weights of another network.
    """
    path = weights_before(job.run_dir.out, stage)
    if path is None:
        return build(job.recipe.model, job.recipe.seed)
    return read_network(path, job.recipe.model, job.recipe.seed)


def read_network(path: Path, config: TicVlaConfig, seed: int) -> TicVla:
    """Load a network; an action expert or value network of another configuration is initialised from the seed.

    The action expert's inputs do not count as configuration: ablations of them start with the same weights.

    Raises TrainError if encoder or language model differ.
    """
    model = build(config, seed)
    try:
        with safe_open(str(path), framework="pt") as file:
            found = config_from_dict(json.loads((file.metadata() or {})["config"]))
            theirs, ours = (replace(of, action=_with_all_inputs(of.action)) for of in (found, config))
            same = [part for part in PARTS if getattr(theirs, part) == getattr(ours, part)]
            if other := sorted(set(SHARED) - set(same)):
                raise TrainError(f"{path}: its {other[0]} differs from the recipe's; train from the first stage")
            tensors = {name: file.get_tensor(name) for name in file.keys() if name.split(".")[0] in same}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, ValueError, ModelConfigError) as error:
        raise TrainError(f"{path}: not weights of edge-train ({error})") from error
    wanted = {name for name in model.state_dict() if name.split(".")[0] in same}
    if set(tensors) != wanted:
        odd = sorted(set(tensors) ^ wanted)
        raise TrainError(f"{path}: expected the tensors of {', '.join(same)}; {odd[0]} is missing or unknown")
    model.load_state_dict(tensors, strict=False)
    return model


def finish_network(job: StageJob, stage: str, model: TicVla) -> Path:
    """Write the network as this stage's weights and as the run's `model.safetensors`; for the first rank alone."""
    path = stage_weights(job.run_dir.out, stage)
    origin = f"edge-train {job.recipe.name}, seed {job.recipe.seed}, after {stage}"
    save_weights(model, path, WeightsInfo(trained=True, origin=origin))
    with replacing(job.run_dir.model_path) as partial:
        shutil.copyfile(path, partial)
    return path


TARGET: Final = "cpu"
COMMAND: Final[Sequence[str]] = (sys.executable, "-m", "export.cli")


class ExportError(RuntimeError):
    """Weights that could not be exported; one line."""


def export_artifacts(
    weights: Path,
    config: TicVlaConfig,
    out: Path,
    log: Callable[[str], None] = lambda line: None,
    command: Sequence[str] = COMMAND,
) -> Path:
    """Export into `out`, unless it contains these weights, and return it.

    Raises ExportError, KeyboardInterrupt, TrainError for a damaged mark of an earlier export.
    """
    digest, mark = file_sha256(weights), out.with_name(out.name + ".json")
    if (out / MANIFEST_NAME).is_file() and mark.is_file():
        if read_record(mark).get("weights_sha256") == digest:
            return out
        mark.unlink()
    out.parent.mkdir(parents=True, exist_ok=True)
    arguments = ["--target", TARGET, "--model", model_argument(config, out), "--checkpoint", str(weights)]
    log(f"exporting the weights of stage {weights.parent.name}")
    log_path = out.with_name(out.name + ".log")
    with log_path.open("wb") as output:
        code = subprocess.run([*command, *arguments, "--out", str(out)], stdout=output, stderr=output, check=False)
    if code.returncode == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code.returncode != EXIT_DONE:
        lines = last_lines(log_path) or [f"see {log_path}"]
        raise ExportError(f"{weights}: edge-export ended with {code.returncode}: {lines[-1]}")
    write_whole(mark, json.dumps({"weights_sha256": digest}) + "\n")
    return out


def model_argument(config: TicVlaConfig, out: Path) -> str:
    """Return the value of `--model`: a preset's name, or the path of a file that is written beside `out`."""
    for name, preset in PRESETS.items():
        if preset == config:
            return name
    path = out.with_name(out.name + ".model.json")
    write_whole(path, json.dumps(config.to_dict(), indent=1) + "\n")
    return str(path)
