"""PyBullet, loaded without the line about its build that it prints on standard error."""

from __future__ import annotations

import importlib
import os
from typing import Any


def _load() -> Any:
    try:
        kept = os.dup(2)
    except OSError:  # no standard error: nothing to keep quiet
        return importlib.import_module("pybullet")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


pybullet = _load()
