"""Targets are data: `export/targets/*.toml`."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from export.graphs import GRAPH_NAMES

TARGETS_DIR = Path(__file__).with_name("targets")
PRECISIONS = ("fp32",)


class TargetError(ValueError):
    """A target that is not known or whose file is wrong."""


@dataclass(frozen=True)
class ParityGate:
    """Thresholds of the check against PyTorch."""

    inputs: int
    min_cosine: float
    max_abs: float
    min_difference: float


@dataclass(frozen=True)
class RuntimePolicy:
    """Rates and lengths that the runner takes from the manifest."""

    tick_period_ms: int
    max_new_tokens: int
    frame_offsets_s: tuple[float, ...]


@dataclass(frozen=True)
class Target:
    """A device to export for."""

    name: str
    description: str
    providers: tuple[str, ...]
    precision: dict[str, str]
    parity: ParityGate
    runtime: RuntimePolicy


def list_targets() -> list[str]:
    """Names of the targets there are."""
    return sorted(path.stem for path in TARGETS_DIR.glob("*.toml"))


def load_target(name: str) -> Target:
    """Read a target by name; raises TargetError with one clear line."""
    path = TARGETS_DIR / f"{name}.toml"
    if name not in list_targets():
        raise TargetError(f"target {name!r} is not known; expected one of: {', '.join(list_targets())}")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise TargetError(f"{path.name}: not TOML ({error})") from error
    return parse_target(content, path.name)


def parse_target(content: dict[str, Any], where: str) -> Target:
    """Validate a target's content; unknown keys are errors."""
    if content.pop("schema", None) != 1:
        raise TargetError(f"{where}: schema must be 1")
    _check_keys(content, Target, where)
    precision = content["precision"]
    if sorted(precision) != sorted(GRAPH_NAMES) or any(value not in PRECISIONS for value in precision.values()):
        raise TargetError(f"{where}: precision must give one of {PRECISIONS} for each of {GRAPH_NAMES}")
    for key, kind in (("parity", ParityGate), ("runtime", RuntimePolicy)):
        _check_keys(content[key], kind, f"{where}: [{key}]")
    runtime = {**content["runtime"], "frame_offsets_s": tuple(content["runtime"]["frame_offsets_s"])}
    return Target(
        name=content["name"],
        description=content["description"],
        providers=tuple(content["providers"]),
        precision=precision,
        parity=ParityGate(**content["parity"]),
        runtime=RuntimePolicy(**runtime),
    )


def _check_keys(content: dict[str, Any], kind: type, where: str) -> None:
    known = {field.name for field in fields(kind)}
    if set(content) != known:
        unknown, missing = sorted(set(content) - known), sorted(known - set(content))
        raise TargetError(f"{where}: unknown keys {unknown}, missing keys {missing}")
