"""A network's numbers from a preset's name, from a JSON file or from `section.field=value` overrides."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from export.model.config import PRESETS, ModelConfigError, TicVlaConfig

MAX_CONFIG_BYTES = 1 << 20


def config_for(model: str) -> TicVlaConfig:
    """The configuration that `--model` names: a preset or a `.json` file; raises ModelConfigError."""
    if model in PRESETS:
        return PRESETS[model]
    if model.endswith(".json"):
        return config_from_file(Path(model))
    raise ModelConfigError(
        f"model {model!r} is not known; expected one of: {', '.join(sorted(PRESETS))}, or a .json file"
    )


def config_from_file(path: Path) -> TicVlaConfig:
    """Read a TicVlaConfig in its `to_dict` form (absent fields keep their defaults); raises ModelConfigError."""
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise ModelConfigError(f"{path}: {path.stat().st_size} bytes, expected a model configuration in JSON")
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, ModelConfigError):
            raise
        raise ModelConfigError(f"{path}: not JSON ({error})") from error
    try:
        return config_from_dict(content)
    except ModelConfigError as error:
        raise ModelConfigError(f"{path}: {error}") from error


def config_from_dict(content: object) -> TicVlaConfig:
    """The inverse of `TicVlaConfig.to_dict`; raises ModelConfigError on unknown keys and values of another type."""
    if not isinstance(content, dict):
        raise ModelConfigError(f"expected an object with name, {', '.join(_sections())}; found {_kind(content)}")
    _check_keys("", content, ["name", *_sections()])
    name = content.get("name")
    if not isinstance(name, str) or not name:
        raise ModelConfigError(f"name is {name!r}, expected a name for this network")
    sections: dict[str, Any] = {}
    for section, cls in _sections().items():
        values = content.get(section, {})
        if not isinstance(values, dict):
            raise ModelConfigError(f"{section} is {_kind(values)}, expected an object")
        hints = typing.get_type_hints(cls)
        _check_keys(f"{section}.", values, list(hints))
        typed = {key: _typed(f"{section}.{key}", value, hints[key]) for key, value in values.items()}
        sections[section] = cls(**typed)
    return TicVlaConfig(name=name, **sections)


def with_overrides(config: TicVlaConfig, overrides: Mapping[str, str]) -> TicVlaConfig:
    """`config` with fields such as `action.layers` replaced by values written as text; raises ModelConfigError."""
    content = config.to_dict()
    fields = {f"{section}.{key}": hint for section, cls in _sections().items() for key, hint in _hints(cls).items()}
    for key, text in overrides.items():
        if key not in fields:
            names = [name for name in fields if name.startswith(key.split(".")[0] + ".")] or list(fields)
            raise ModelConfigError(f"{key} is not a number of the model; expected one of: {', '.join(names)}")
        section, field = key.split(".")
        content[section][field] = _parsed(key, text, fields[key])
    return config_from_dict(content)


def _sections() -> dict[str, type]:
    return {
        key: hint
        for key, hint in _hints(TicVlaConfig).items()
        if isinstance(hint, type) and dataclasses.is_dataclass(hint)
    }


def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _kind(value: object) -> str:
    return "nothing" if value is None else type(value).__name__


def _check_keys(prefix: str, values: Mapping[str, object], expected: list[str]) -> None:
    unknown = sorted(set(values) - set(expected))
    if unknown:
        raise ModelConfigError(f"{prefix}{unknown[0]} is not known; expected one of: {', '.join(expected)}")


def _typed(name: str, value: Any, hint: Any) -> Any:
    """`value` as the dataclass wants it: JSON has neither tuples nor a difference between 1 and 1.0."""
    items = typing.get_args(hint)
    if items:
        if not isinstance(value, list | tuple) or (items[-1] is not Ellipsis and len(value) != len(items)):
            count = "any number of" if items[-1] is Ellipsis else str(len(items))
            raise ModelConfigError(f"{name} is {value!r}, expected a list of {count} {items[0].__name__}")
        return tuple(_typed(name, item, items[0]) for item in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not hint or (hint is float and abs(value) == float("inf")) or value != value:
        raise ModelConfigError(f"{name} is {value!r}, expected {hint.__name__}")
    return value


def _parsed(name: str, text: str, hint: Any) -> Any:
    if hint is str:
        return text
    try:
        # "3", "0.1", "true" and "[24, 48]" are JSON; a bare "24,48" is a list without its brackets.
        return json.loads(f"[{text}]" if typing.get_args(hint) and not text.lstrip().startswith("[") else text)
    except (ValueError, RecursionError) as error:
        kind = "a list" if typing.get_args(hint) else hint.__name__
        raise ModelConfigError(f"{name}={text}: expected {kind}") from error
