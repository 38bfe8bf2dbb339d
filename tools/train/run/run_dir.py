"""The folder of a training run: recipe, versions, a folder a stage, the log of numbers and the weights."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from export import model
from sim_hil.benchmark.workers.code_version import code_sha256
from tools.train.config.recipe import STAGES, Recipe, load_recipe
from tools.train.run.optim import computes_bf16

VERSIONS: Final = "versions.json"
TIMINGS: Final = "timings.json"
SHARED_PARTS: Final = ("vision", "language")
"""Of the network: what another run's encoder and language model are used in."""
PACKAGES: Final = ("numpy", "torch", "onnxruntime", "opencv-python-headless", "tokenizers", "panda3d", "pybullet")
"""Whose versions decide what a run gives."""


class RunDirError(ValueError):
    """A folder that is not the run that was asked for; one line: what, expected, found."""


class RunDir:
    """`out/{recipe.toml,versions.json,timings.json,collect/,…,model.safetensors,curves/*.png,log.jsonl}`."""

    def __init__(self, out: Path) -> None:
        self.out = out

    @staticmethod
    def open(out: Path, recipe: Recipe) -> RunDir:
        """Make the folder, or go on with the run in it; raises RunDirError if it holds another run.

        Stages may be started one by one, and numbers of a stage that has not begun may still be changed.
        """
        run_dir = RunDir(out)
        if run_dir.recipe_path.exists():
            if changed := run_dir._changed(recipe):
                raise RunDirError(
                    f"{out}: was begun with other numbers ({changed}); name another --out, or leave them as they were"
                )
        elif out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise RunDirError(f"{out}: expected a new or empty directory, or one that edge-train has made")
        out.mkdir(parents=True, exist_ok=True)
        run_dir._note_versions()
        write_whole(run_dir.recipe_path, recipe.to_toml())
        return run_dir

    def _note_versions(self) -> None:
        """What the run began with, and below `later` whatever else it went on with."""
        path, now = self.out / VERSIONS, versions()
        first = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
        later = [] if first is None else first.get("later", [])
        if first is None:
            first = now
        elif now not in ({key: value for key, value in first.items() if key != "later"}, *later):
            first["later"] = [*later, now]
        else:
            return
        write_whole(path, json.dumps(first, indent=1) + "\n")

    def _changed(self, recipe: Recipe) -> str:
        """The first number of what has begun that differs from the recipe's; empty: none."""
        found, asked = load_recipe(str(self.recipe_path)).to_tables(), recipe.to_tables()
        begun = [name for name in STAGES if self.begun(name)]
        fixed = [*begun, *(("seed", "name", "model") if begun else ())]
        if any(self.out.glob("dagger-*")):
            fixed.append("dagger")
        for section in fixed:
            if difference := _difference(section, found.get(section), asked.get(section)):
                return difference
        return ""

    def begun(self, stage: str) -> bool:
        """Whether a stage has left anything."""
        folder = self.out / stage
        return folder.is_dir() and any(folder.iterdir())

    def borrow(self, other: RunDir, stages: Sequence[str], recipe: Recipe) -> None:
        """Use finished stages of another run as they are, by links; raises RunDirError if they would be others here."""
        if not other.recipe_path.exists():
            raise RunDirError(f"--from {other.out}: holds no run of edge-train")
        found, asked = load_recipe(str(other.recipe_path)).to_tables(), recipe.to_tables()
        for stage in stages:
            if other.result(stage) is None:
                raise RunDirError(f"--from {other.out}: its stage {stage} has not finished")
            if difference := _difference(stage, found[stage], asked[stage]):
                raise RunDirError(f"--from {other.out}: was trained with other numbers ({difference})")
        for part in SHARED_PARTS:
            if difference := _difference(f"model.{part}", found["model"][part], asked["model"][part]):
                raise RunDirError(f"--from {other.out}: its {part} is another one ({difference})")
        for stage in stages:
            link = self.out / stage
            if not link.exists():
                link.symlink_to(os.path.relpath((other.out / stage).resolve(), self.out.resolve()))

    def borrowed(self, stage: str) -> bool:
        """Whether a stage is another run's."""
        return (self.out / stage).is_symlink()

    def retire(self, stage: str, name: str) -> None:
        """Keep what a stage has left, and its lines of the log, under another name: the stage is to be done again."""
        (self.out / stage).rename(self.out / name)
        lines = [{**line, "stage": name} if line["stage"] == stage else line for line in self.lines()]
        if lines:
            write_whole(self.log_path, "".join(json.dumps(line) + "\n" for line in lines))

    def retired(self, stage: str) -> int:
        """How often a stage was kept aside, to go on after a round of DAgger."""
        number = 0
        while self.begun(f"{stage}-{number}"):
            number += 1
        return number

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

    def timings(self) -> dict[str, float]:
        """Seconds that each step has taken so far, all its resumptions together."""
        path = self.out / TIMINGS
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}

    def add_time(self, step: str, seconds: float) -> None:
        """Count time to a step."""
        timings = self.timings()
        timings[step] = round(timings.get(step, 0.0) + seconds, 1)
        write_whole(self.out / TIMINGS, json.dumps(timings, indent=1) + "\n")

    def result(self, stage: str) -> dict[str, Any] | None:
        """What a finished stage gave; None if it has not finished."""
        path = self.out / stage / "result.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def finish(self, stage: str, result: Mapping[str, object]) -> None:
        """Say that a stage is done, and what it gave."""
        write_whole(self.stage(stage) / "result.json", json.dumps(result, indent=1, sort_keys=True) + "\n")


def _difference(where: str, found: object, asked: object) -> str:
    """`where.key: A there, B asked for` of the first difference of two tables; empty: there is none."""
    if isinstance(found, Mapping) and isinstance(asked, Mapping):
        keys = sorted({*found, *asked} - {"jobs"})  # how many processes worked on it changes nothing
        return next((d for key in keys if (d := _difference(f"{where}.{key}", found.get(key), asked.get(key)))), "")
    same = json.dumps(found) == json.dumps(asked)
    return "" if same else f"{where}: {json.dumps(found)} there, {json.dumps(asked)} asked for"


def versions() -> dict[str, Any]:
    """Of everything that decides what a run gives, and the machine it ran on."""
    found: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    machine = {
        "machine": platform.machine(),
        "bfloat16": computes_bf16("cpu"),
        "cpus": os.cpu_count(),
        "system": platform.platform(),
    }
    code = {"simulation": code_sha256(), "training": _training_sha256()}
    return {"python": platform.python_version(), "packages": found, "code_sha256": code, **machine}


def _training_sha256() -> str:
    """Of the sources and recipes that training consists of, beside what it simulates with."""
    digest = hashlib.sha256()
    for root in (Path(__file__).parents[1], Path(model.__path__[0])):
        for path in sorted(path for path in root.rglob("*") if path.suffix in (".py", ".toml", ".json")):
            digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
