"""The folder of a training run: recipe, versions, one folder per stage, the log, the weights, and the run's drives."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from export import model
from firmware_bridge.system.input_file import parse_json, read_json
from sim_hil.benchmark.workers.code_version import code_sha256
from tools.train.config.checks import TrainError, check_run_folder
from tools.train.config.recipe import STAGES, Recipe, load_recipe
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Dataset
from tools.train.run.distributed import computes_bf16

VERSIONS: Final = "versions.json"
TIMINGS: Final = "timings.json"
SHARED_PARTS: Final = ("vision", "language")
"""Parts of the network that --from takes from another run."""
PACKAGES: Final = ("numpy", "torch", "onnxruntime", "opencv-python-headless", "tokenizers", "panda3d", "pybullet")
"""Packages whose versions affect a run's result."""
_RESTORE: Final = "restore it, or train in another folder"


class RunDir:
    """`out/{recipe.toml,versions.json,timings.json,collect/,…,model.safetensors,curves/*.png,log.jsonl}`."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.recipe_path, self.model_path = out / "recipe.toml", out / "model.safetensors"
        self.log_path, self.curves = out / "log.jsonl", out / "curves"

    @staticmethod
    def open(out: Path, recipe: Recipe) -> RunDir:
        """Create the folder or reopen the run in it. Raises TrainError if it contains another run.

        The configuration of a stage that has not started may still be changed.
        """
        run_dir = RunDir(out)
        if run_dir.recipe_path.exists() and (changed := run_dir._changed(recipe)):
            raise TrainError(
                f"{out}: was started with another recipe ({changed}); name another --out, or restore the values"
            )
        check_run_folder(out)
        out.mkdir(parents=True, exist_ok=True)
        run_dir._note_versions()
        write_whole(run_dir.recipe_path, recipe.to_toml())
        return run_dir

    def _note_versions(self) -> None:
        """Write the versions that the run started with, and under `later` those that it was continued with."""
        path, now = self.out / VERSIONS, versions()
        first = read_record(path) if path.exists() else None
        later = [] if first is None else first.get("later", [])
        if not isinstance(later, list):
            raise TrainError(f"{path}: expected a list under 'later', found {later!r:.80}; {_RESTORE}")
        if first is None:
            first = now
        elif now not in ({key: value for key, value in first.items() if key != "later"}, *later):
            first["later"] = [*later, now]
        else:
            return
        write_whole(path, json.dumps(first, indent=1) + "\n")

    def other_code(self) -> bool:
        """Return whether the run began with other code than this: what it records from now on may differ."""
        first = read_record(self.out / VERSIONS)
        return bool(first.get("code_sha256") != versions()["code_sha256"])

    def _changed(self, recipe: Recipe) -> str:
        """Return the first value of a started stage that differs from the recipe's; empty if none does."""
        found, expected = load_recipe(str(self.recipe_path)).to_tables(), recipe.to_tables()
        begun = [name for name in STAGES if self.begun(name)]
        fixed = [*begun, *(("seed", "name", "model") if begun else ())]
        if any(self.out.glob("dagger-*")):
            fixed.append("dagger")
        for section in fixed:
            if difference := _difference(section, found.get(section), expected.get(section)):
                return difference
        return ""

    def begun(self, stage: str) -> bool:
        """Return whether a stage has written files."""
        folder = self.out / stage
        return folder.is_dir() and any(folder.iterdir())

    def borrow(self, other: RunDir, stages: Sequence[str], recipe: Recipe) -> None:
        """Link finished stages of another run. Raises TrainError if this recipe would give other results."""
        if not other.recipe_path.exists():
            raise TrainError(f"--from {other.out}: not a run folder of edge-train")
        found, expected = load_recipe(str(other.recipe_path)).to_tables(), recipe.to_tables()
        for stage in stages:
            if other.result(stage) is None:
                raise TrainError(f"--from {other.out}: stage {stage} has not finished")
            if difference := _difference(stage, found[stage], expected[stage]):
                raise TrainError(f"--from {other.out}: was trained with another recipe ({difference})")
        for part in SHARED_PARTS:
            if difference := _difference(f"model.{part}", found["model"][part], expected["model"][part]):
                raise TrainError(f"--from {other.out}: its {part} differs ({difference})")
        for stage in stages:
            link = self.out / stage
            if not link.exists():
                link.symlink_to(os.path.relpath((other.out / stage).resolve(), self.out.resolve()))

    def borrowed(self, stage: str) -> bool:
        """Return whether a stage belongs to another run."""
        return (self.out / stage).is_symlink()

    def retire(self, stage: str, name: str) -> None:
        """Keep a stage's files and log lines under another name, so that the stage can run again."""
        (self.out / stage).rename(self.out / name)
        lines = [{**line, "stage": name} if line["stage"] == stage else line for line in self.lines()]
        if lines:
            write_whole(self.log_path, "".join(json.dumps(line) + "\n" for line in lines))

    def retired(self, stage: str) -> int:
        """Return how often a stage was retired to continue after a DAgger round."""
        number = 0
        while self.begun(f"{stage}-{number}"):
            number += 1
        return number

    def stage(self, name: str) -> Path:
        """Return the folder of a stage; create it if needed."""
        folder = self.out / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def log(self, stage: str, step: int, **numbers: float) -> None:
        """Append one line with the values of a stage's step; for the first rank alone."""
        line = json.dumps({"stage": stage, "step": step, **numbers})
        with self.log_path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def rewind(self, stage: str, step: int) -> None:
        """Remove a stage's lines after `step`: a resumed stage writes them again."""
        lines = list(self.lines())
        kept = [line for line in lines if line["stage"] != stage or line["step"] <= step]
        if len(kept) != len(lines):
            write_whole(self.log_path, "".join(json.dumps(line) + "\n" for line in kept))

    def lines(self) -> Iterator[dict[str, Any]]:
        """Yield the log's lines in order; damaged ones, such as an incomplete last line, are left out."""
        if not self.log_path.exists():
            return
        for text in self.log_path.read_bytes().splitlines():
            try:
                line = parse_json(text)
            except ValueError:
                continue
            if isinstance(line, dict) and isinstance(line.get("stage"), str) and isinstance(line.get("step"), int):
                yield line

    def timings(self) -> dict[str, float]:
        """Return the seconds that each step has taken, including resumed parts. Raises TrainError."""
        path = self.out / TIMINGS
        found = read_record(path) if path.exists() else {}
        if not all(isinstance(seconds, int | float) for seconds in found.values()):
            raise TrainError(f"{path}: expected seconds by step, found {found!r:.80}; delete it")
        return found

    def add_time(self, step: str, seconds: float) -> None:
        """Add to the time of a step."""
        timings = self.timings()
        timings[step] = round(timings.get(step, 0.0) + seconds, 1)
        write_whole(self.out / TIMINGS, json.dumps(timings, indent=1) + "\n")

    def result(self, stage: str) -> dict[str, Any] | None:
        """Return the result of a finished stage; None if it has not finished. Raises TrainError."""
        path = self.out / stage / "result.json"
        return read_record(path) if path.exists() else None

    def finish(self, stage: str, result: Mapping[str, object]) -> None:
        """Write the result of a stage, which marks it as finished."""
        write_whole(self.stage(stage) / "result.json", json.dumps(result, indent=1, sort_keys=True) + "\n")


def read_record(path: Path) -> dict[str, Any]:
    """Read a JSON object that a run wrote. Raises TrainError."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise TrainError(
            f"{path}: expected a JSON object of edge-train, cannot be read ({error}); {_RESTORE}"
        ) from error
    if not isinstance(content, dict):
        raise TrainError(f"{path}: expected a JSON object of edge-train, found {content!r:.80}; {_RESTORE}")
    return content


def _difference(where: str, found: object, expected: object) -> str:
    """Describe the first difference of two tables as `where.key: found A, recipe B`; empty if they are equal."""
    if isinstance(found, Mapping) and isinstance(expected, Mapping):
        keys = sorted({*found, *expected} - {"jobs"})  # the number of processes does not change the result
        return next((d for key in keys if (d := _difference(f"{where}.{key}", found.get(key), expected.get(key)))), "")
    same = json.dumps(found) == json.dumps(expected)
    return "" if same else f"{where}: found {json.dumps(found)}, recipe {json.dumps(expected)}"


def versions() -> dict[str, Any]:
    """Return the versions of everything that affects a run's result, and properties of the machine."""
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
    """Hash the sources and recipes of the training code."""
    digest = hashlib.sha256()
    for root in (Path(__file__).parents[1], Path(model.__path__[0])):
        for path in sorted(path for path in root.rglob("*") if path.suffix in (".py", ".toml", ".json")):
            digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


_PARTIAL: Final = "collect.partial"
IMPORTED: Final = "imported"
"""Key in the result of `collect`: the drives were imported."""


def prefixes_of(round_number: int) -> tuple[str, str]:
    """Return the id prefixes of a round's drives, the policy's and the expert's; rounds count from 1."""
    return f"d{round_number}-", f"n{round_number}-"


def drives_after(run_dir: RunDir, recipe: Recipe, stage: str) -> Dataset:
    """Return the drives that a stage trains on: all, or those of the newest round (`dagger.newest_only`)."""
    dataset, rounds = Dataset.open(run_dir.stage("collect")), run_dir.retired(stage)
    return dataset.of(*prefixes_of(rounds)) if rounds and recipe.dagger.newest_only else dataset


def take_drives(run_dir: RunDir, folder: Path) -> dict[str, Any]:
    """Import the data set in `folder` as the result of the run's stage `collect`; files are hard-linked if possible.

    An interrupted call leaves no drives. Returns the stage's result. Raises TrainError for a damaged data set
    or if the run has other drives.
    """
    dataset = Dataset.open(folder)
    done = run_dir.result("collect")
    if done is not None and done.get(IMPORTED) is True and done["sha256"] == dataset.sha256:
        return done
    if run_dir.begun("collect"):
        raise TrainError(f"--drives {folder}: {run_dir.out} has other drives; name another --out")
    Dataset.open(folder, verify=True)
    partial = run_dir.out / _PARTIAL
    shutil.rmtree(partial, ignore_errors=True)
    with DatasetWriter(partial) as writer:
        for entry in dataset.entries:
            _link_or_copy(dataset.path(entry.id).resolve(), writer.path(entry.id))
            writer.add(entry)
        result = {IMPORTED: True, **writer.summary(""), "sha256": writer.finish().sha256}
    run_dir.finish(_PARTIAL, result)
    partial.replace(run_dir.out / "collect")
    return result


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links
        shutil.copyfile(source, target)
