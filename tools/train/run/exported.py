"""Artifacts of a run's weights, made by `edge-export` in a separate process, as for a robot."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from edge.artifacts.files import MANIFEST_NAME
from edge.core.cli import EXIT_DONE, EXIT_INTERRUPTED, write_whole
from export.model.config import PRESETS, TicVlaConfig
from sim_hil.processes.child_process import last_lines
from tools.train.drives.drive import file_sha256

TARGET: Final = "cpu"
COMMAND: Final[Sequence[str]] = (sys.executable, "-m", "export.cli")


class ExportError(RuntimeError):
    """Weights that could not be exported; one line."""


def export_artifacts(
    weights: Path,
    config: TicVlaConfig,
    out: Path,
    say: Callable[[str], None] = lambda line: None,
    command: Sequence[str] = COMMAND,
) -> Path:
    """Export into `out`, unless it contains these weights, and return it. Raises ExportError, KeyboardInterrupt."""
    digest, mark = file_sha256(weights), out.with_name(out.name + ".json")
    if (out / MANIFEST_NAME).is_file() and mark.is_file():
        if json.loads(mark.read_text(encoding="utf-8")).get("weights_sha256") == digest:
            return out
        mark.unlink()
    out.parent.mkdir(parents=True, exist_ok=True)
    arguments = ["--target", TARGET, "--model", model_argument(config, out), "--checkpoint", str(weights)]
    say(f"exporting the weights of stage {weights.parent.name}")
    log = out.with_name(out.name + ".log")
    with log.open("wb") as output:
        code = subprocess.run([*command, *arguments, "--out", str(out)], stdout=output, stderr=output, check=False)
    if code.returncode == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code.returncode != EXIT_DONE:
        lines = last_lines(log) or [f"see {log}"]
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
