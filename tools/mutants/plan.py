"""What `python -m tools.mutants` changes, the results so far, and their table."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from firmware_bridge.system.input_file import read_toml
from tools.mutants.operators import mutants_of
from tools.mutants.session import KILLED, TIMEOUT

HERE: Final = Path(__file__).parent
DONE: Final = (KILLED, TIMEOUT)


def read_targets() -> dict[str, list[str]]:
    """Return the test files of each module."""
    targets: dict[str, list[str]] = read_toml(HERE / "targets.toml")
    return targets


def read_equivalents() -> dict[str, dict[str, str]]:
    """Return the reason of each equivalent mutant, by module and key."""
    found: dict[str, dict[str, str]] = {}
    entries: list[dict[str, Any]] = read_toml(HERE / "equivalents.toml").get("equivalent", [])
    for entry in entries:
        found.setdefault(entry["module"], {}).update(dict.fromkeys(entry["mutants"], entry["reason"]))
    return found


def source_of(module: str) -> str:
    """Return the source of a module without importing it."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ValueError(f"{module}: expected a module of this project")
    return Path(spec.origin).read_text(encoding="utf-8")


class Results:
    """Results of one module on disk, one line each; those of another version of its source are dropped."""

    def __init__(self, folder: Path, module: str) -> None:
        """Read what is there. Raises OSError or ValueError."""
        self._file = folder / f"{module}.jsonl"
        self._head = json.dumps({"source": hashlib.sha256(source_of(module).encode()).hexdigest()})
        self.found: dict[str, str] = {}
        lines = self._file.read_text(encoding="utf-8").splitlines() if self._file.exists() else []
        if lines and lines[0] == self._head:
            for line in lines[1:]:
                self.found.update(json.loads(line))
        else:
            folder.mkdir(parents=True, exist_ok=True)
            self._file.write_text(self._head + "\n", encoding="utf-8")

    def add(self, key: str, result: str) -> None:
        """Store a result at once, so that the next call goes on behind it."""
        self.found[key] = result
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps({key: result}) + "\n")


@dataclass(frozen=True)
class Row:
    """Counts of one module, and the mutants that no test kills."""

    module: str
    mutants: int
    killed: int
    equivalent: int
    unfinished: int
    survivors: tuple[str, ...]

    @property
    def text(self) -> str:
        """The row of the table."""
        counts = (self.mutants, self.killed, self.equivalent, len(self.survivors), self.unfinished)
        return f"| `{self.module}` | {' | '.join(map(str, counts))} |"


TABLE_HEAD: Final = "| module | mutants | killed | equivalent | survived | not run |\n|---|---:|---:|---:|---:|---:|"


def row_of(module: str, found: Mapping[str, str], equivalent: Mapping[str, str]) -> Row:
    """Count one module's results."""
    keys = [mutant.key for mutant in mutants_of(source_of(module))]
    results = Counter(found[key] in DONE for key in keys if key in found and key not in equivalent)
    survivors = tuple(key for key in keys if key not in equivalent and found.get(key, KILLED) not in DONE)
    same = sum(key in equivalent for key in keys)
    return Row(module, len(keys), results[True], same, len(keys) - results.total() - same, survivors)
