"""Exit codes and result files that every command line shares (design §9)."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXIT_DONE = 0
EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_REFUSED = 3
EXIT_INTERRUPTED = 130


def write_result(where: str | None, result: Mapping[str, Any]) -> None:
    """Write a result as JSON to a file (in one rename) or to standard output for `-`; raises OSError."""
    if where is None:
        return
    text = json.dumps(result, indent=1) + "\n"
    if where == "-":
        sys.stdout.write(text)
        return
    path = Path(where)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
