"""The folder of a training run: recipe, versions, a folder a stage, the log of numbers and the weights."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from edge.cli import write_whole
from tools.train.recipe import Recipe

PACKAGES: Final = ("numpy", "torch", "onnxruntime", "opencv-python-headless", "tokenizers", "panda3d", "pybullet")
"""Whose versions decide what a run gives."""


class RunDirError(ValueError):
    """A folder that is not the run that was asked for; one line: what, expected, found."""


class RunDir:
    """`out/{recipe.toml,versions.json,collect/,…,model.safetensors,curves/*.png,log.jsonl}`."""

    def __init__(self, out: Path) -> None:
        self.out = out

    @staticmethod
    def open(out: Path, recipe: Recipe, *, resume: bool) -> RunDir:
        """Make the folder, or continue the run in it; raises RunDirError if it holds another run.

        Stages of one run may be started one by one: the folder of the same recipe is always welcome. `resume` decides
        whether a stage that was begun goes on; it is looked at by the stages.
        """
        run_dir = RunDir(out)
        text = recipe.to_toml()
        if run_dir.recipe_path.exists():
            if run_dir.recipe_path.read_text(encoding="utf-8") != text:
                raise RunDirError(f"{out}: holds a run of another recipe; name another --out, or use its recipe.toml")
        elif resume:
            raise RunDirError(f"{out}: holds no run to resume; leave out --resume, or name its folder")
        elif out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RunDirError(f"{out}: expected a new or empty directory, or one that edge-train has made")
        else:
            out.mkdir(parents=True, exist_ok=True)
            write_whole(run_dir.out / "versions.json", json.dumps(versions(), indent=1) + "\n")
            write_whole(run_dir.recipe_path, text)
        return run_dir

    @property
    def recipe_path(self) -> Path:
        """Every number of the run."""
        return self.out / "recipe.toml"

    @property
    def model_path(self) -> Path:
        """The whole network's weights, as of the last stage that finished."""
        return self.out / "model.safetensors"

    @property
    def log_path(self) -> Path:
        """One JSON object a line: `{"stage", "step", numbers…}`."""
        return self.out / "log.jsonl"

    @property
    def curves(self) -> Path:
        """Folder of the pictures."""
        return self.out / "curves"

    def stage(self, name: str) -> Path:
        """Folder of a stage, made if it is not there."""
        folder = self.out / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def log(self, stage: str, step: int, **numbers: float) -> None:
        """Append one line of numbers of a stage's step (called by rank 0 only)."""
        line = json.dumps({"stage": stage, "step": step, **numbers})
        with self.log_path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def rewind(self, stage: str, step: int) -> None:
        """Forget a stage's lines after `step`: a resumed stage writes them again."""
        lines = list(self.lines())
        kept = [line for line in lines if line["stage"] != stage or line["step"] <= step]
        if len(kept) != len(lines):
            write_whole(self.log_path, "".join(json.dumps(line) + "\n" for line in kept))

    def lines(self) -> Iterator[dict[str, Any]]:
        """The log's lines in order; half a line at the end, of a process that was killed, is left out."""
        if not self.log_path.exists():
            return
        for line in self.log_path.read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                continue

    def result(self, stage: str) -> dict[str, Any] | None:
        """What a finished stage gave; None if it has not finished."""
        path = self.out / stage / "result.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def finish(self, stage: str, result: Mapping[str, Any]) -> None:
        """Say that a stage is done, and what it gave."""
        write_whole(self.stage(stage) / "result.json", json.dumps(result, indent=1, sort_keys=True) + "\n")


def versions() -> dict[str, Any]:
    """Of everything that decides what a run gives, and the machine it ran on."""
    found: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    machine = {"machine": platform.machine(), "cpus": os.cpu_count(), "system": platform.platform()}
    return {"python": platform.python_version(), "packages": found, **machine}
