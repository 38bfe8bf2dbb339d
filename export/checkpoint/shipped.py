"""Trained weights that come with the package: what a network is exported with when nobody names others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open

from export.checkpoint.coverage import CheckpointError
from export.model.config import TicVlaConfig
from export.model.config_file import config_from_dict

FOLDER: Final = Path(__file__).parents[1] / "weights"


def shipped_weights(config: TicVlaConfig, folder: Path = FOLDER) -> Path | None:
    """The file for this very network; None if there is none. Raises CheckpointError for one that cannot be read.

    A network of that name with changed numbers (`--set model.…`) has none: it would have to be trained.
    """
    path = folder / f"{config.name}.safetensors"
    if not path.is_file():
        return None
    try:
        with safe_open(str(path), framework="pt") as file:
            said = config_from_dict(json.loads((file.metadata() or {})["config"]))
        return path if said == config else None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: the shipped weights cannot be read ({error}); install the package again"
        ) from error
