"""A file of JSON lines that is whole up to its last line whatever ends the process: each one is flushed."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any


class LineFile:
    """Appends objects to a file; raises OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8")

    def add(self, content: dict[str, Any]) -> None:
        """Append one."""
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()

    def __enter__(self) -> LineFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
