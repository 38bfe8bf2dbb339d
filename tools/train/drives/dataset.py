"""Writing of a data set: drives are added one by one, in any order, and an interrupted run continues.

`index.jsonl` receives one line for each added or dropped drive. `dataset.json` is the sorted index that is written at
the end: the same drives give the same file in any order.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, Final

from edge.core.cli import write_whole
from tools.train.config.checks import TrainError
from tools.train.drives.drive import DRIVES, FORMAT, INDEX, Dataset, Entry, intact

LINES: Final = "index.jsonl"


@dataclass(frozen=True)
class Dropped:
    """A drive that could not be recorded, and the reason."""

    id: str
    why: str


class DatasetWriter:
    """The only writer of a data set; methods raise OSError if the disk fails."""

    def __init__(self, folder: Path) -> None:
        """Create a data set, or continue one without drives whose file is damaged. Raises TrainError."""
        (folder / DRIVES).mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._lock = _locked(folder)
        self._entries: dict[str, Entry] = {}
        self._dropped: dict[str, Dropped] = {}
        for partial in (folder / DRIVES).glob("*.partial"):
            partial.unlink()
        for entry in _read(folder / LINES):
            if isinstance(entry, Dropped):
                self._dropped[entry.id] = entry
            elif intact(self.path(entry.id), entry):
                self._entries[entry.id] = entry
        self._rewrite()

    def path(self, drive_id: str) -> Path:
        """Return the path of a drive's file."""
        return self.folder / DRIVES / f"{drive_id}.safetensors"

    def has(self, drive_id: str) -> bool:
        """Return whether a drive was added or dropped."""
        return drive_id in self._entries or drive_id in self._dropped

    def entries(self, prefix: str = "") -> list[Entry]:
        """Return the added drives whose id begins with `prefix`, sorted."""
        return [entry for key, entry in sorted(self._entries.items()) if key.startswith(prefix)]

    def dropped(self, prefix: str = "") -> list[Dropped]:
        """Return the dropped drives whose id begins with `prefix`, sorted."""
        return [dropped for key, dropped in sorted(self._dropped.items()) if key.startswith(prefix)]

    def add(self, entry: Entry) -> None:
        """Add a drive whose file has been written."""
        self._entries[entry.id] = entry
        self._append({"drive": asdict(entry)})

    def drop(self, drive_id: str, why: str) -> None:
        """Record that a drive is missing, and why."""
        self._dropped[drive_id] = Dropped(drive_id, why)
        self._append({"dropped": asdict(self._dropped[drive_id])})

    def finish(self) -> Dataset:
        """Write the index of the added drives and open the data set."""
        drives = [asdict(entry) for entry in self.entries()]
        dropped = [asdict(each) for each in self.dropped()]
        content = {"format": FORMAT, "drives": drives, "dropped": dropped}
        write_whole(self.folder / INDEX, json.dumps(content, indent=1, sort_keys=True) + "\n")
        return Dataset.open(self.folder)

    def summary(self, prefix: str = "") -> dict[str, Any]:
        """Return counts for a result: drives, frames, bytes, collisions, outcomes, kinds, reasons of dropped drives."""
        entries, dropped = self.entries(prefix), self.dropped(prefix)
        return {
            "drives": len(entries),
            "frames": sum(entry.frames for entry in entries),
            "bytes": sum(entry.bytes for entry in entries),
            "val_drives": sum(entry.val for entry in entries),
            "collided": sum(entry.collided for entry in entries),
            "outcomes": dict(sorted(Counter(entry.outcome for entry in entries).items())),
            "kinds": dict(sorted(Counter(entry.kind for entry in entries).items())),
            "dropped": dict(sorted(Counter(each.why for each in dropped).items())),
        }

    def close(self) -> None:
        """Release the lock for other writers."""
        self._lock.close()

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, content: Mapping[str, object]) -> None:
        with (self.folder / LINES).open("a", encoding="utf-8") as file:
            file.write(json.dumps(content) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def _rewrite(self) -> None:
        """Rewrite the lines without truncated ones and without drives whose files are missing."""
        lines = [{"drive": asdict(entry)} for entry in self.entries()]
        lines += [{"dropped": asdict(each)} for each in self.dropped()]
        write_whole(self.folder / LINES, "".join(json.dumps(line) + "\n" for line in lines))


def _read(path: Path) -> list[Entry | Dropped]:
    """Read all complete lines; the last line may be truncated."""
    if not path.exists():
        return []
    found: list[Entry | Dropped] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            content = json.loads(line)
            found.append(Entry(**content["drive"]) if "drive" in content else Dropped(**content["dropped"]))
        except (ValueError, KeyError, TypeError):
            continue
    return found


def _locked(folder: Path) -> IO[bytes]:
    lock = (folder / ".lock").open("wb")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise TrainError(f"{folder}: another process is writing this data set; wait for it or end it") from error
    return lock
