"""File of JSON lines that stays complete if the process is killed: every line is flushed."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any


class LineFile:
    """Writer that appends JSON objects to a file. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8")

    def add(self, content: dict[str, Any]) -> None:
        """Append one object."""
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()

    def __enter__(self) -> LineFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
