"""The recipe of a training run: network, seed and a table per stage, read strictly from TOML; the paper's variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, get_args, get_origin
from zlib import crc32

import numpy as np
import tomli_w

from export.core.typed import FieldError, build, field_types, from_text, near, plain
from export.model.config import (
    MODEL_PREFIX,
    ModelConfigError,
    TicVlaConfig,
    config_for,
    config_from_dict,
    model_settings,
    with_overrides,
)
from firmware_bridge.system.input_file import read_toml
from tools.train.config.collect import KINDS, CollectConfig, DaggerConfig
from tools.train.config.encoder import EncoderConfig
from tools.train.config.imitate import ImitateConfig
from tools.train.config.rl import EvaluateConfig, RlConfig
from tools.train.config.sft import SftConfig

SCHEMA: Final = 1
FOLDER: Final = Path(__file__).parent / "recipes"
STAGES: Final[Mapping[str, type]] = {
    "collect": CollectConfig,
    "encoder": EncoderConfig,
    "sft": SftConfig,
    "imitate": ImitateConfig,
    "rl": RlConfig,
    "evaluate": EvaluateConfig,
}
"""Configuration class of each stage."""
ALL: Final = ("collect", "encoder", "sft", "imitate", "dagger", "rl", "evaluate")
"""All stages in their order, with `dagger`, which has no table of a stage."""
_UNAWARE: Final = ("model.action.latency_aware=false", "imitate.inject_delay=false")
VARIANTS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "full": (),
        "waypoints": ("model.action.semantic_interface=waypoints",),
        "waypoints-no-latency": ("model.action.semantic_interface=waypoints", *_UNAWARE),
        "values-only": ("model.action.semantic_interface=values-only",),
        "no-latency": _UNAWARE,
        "no-motion-offset": ("model.action.motion_offset=false",),
        "no-reasoning": ("imitate.sample.reasoning=false",),
        "offsets": ("model.action.parameterisation=offsets",),
        "horizon-1s": ("model.action.steps=10",),
        "horizon-5s": ("model.action.steps=50",),
        "depth-3": ("model.action.layers=3",),
        "depth-12": ("model.action.layers=12",),
        "diffusion": ("model.action.head=diffusion",),
        "flow": ("model.action.head=flow",),
        "point-goal-bc": ("imitate.policy=point-goal",),
        # Trained from scratch, whereas the recipe's values are for a policy that already drives.
        "point-goal-rl": (
            "rl.policy=point-goal",
            "rl.ppo.action_lr=3e-4",
            "rl.log_std=-1.2,-0.7",
            "rl.warmup_iterations=0",
            "rl.imitation=0.0",
        ),
    }
)
"""The paper's ablations and baselines as settings (tables 1, 2, 5, 6, 11, 13), named as in the benchmark."""
MAX_RECIPE_BYTES: Final = 1 << 20
"""Upper limit of a recipe file, bytes."""


class RecipeError(ValueError):
    """A recipe that cannot be used; one line: what, expected, found."""


@dataclass(frozen=True)
class Recipe:
    """Configuration of one training run."""

    name: str
    seed: int
    model: TicVlaConfig
    collect: CollectConfig = field(default_factory=CollectConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    sft: SftConfig = field(default_factory=SftConfig)
    imitate: ImitateConfig = field(default_factory=ImitateConfig)
    rl: RlConfig = field(default_factory=RlConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    dagger: DaggerConfig = field(default_factory=DaggerConfig)

    def __post_init__(self) -> None:
        if not self.name or not 0 <= self.seed < 2**31:
            raise RecipeError(f"expected a name and a seed from 0 to 2^31 - 1, found {self.name!r} and {self.seed}")

    def to_tables(self) -> dict[str, Any]:
        """Return every value of the run, defaults included, as plain tables."""
        head = {"schema": SCHEMA, "name": self.name, "seed": self.seed, "model": self.model.to_dict()}
        return head | {name: plain(getattr(self, name)) for name in (*STAGES, "dagger")}

    def to_toml(self) -> str:
        """Return the tables as TOML; `load_recipe` reads it."""
        return tomli_w.dumps(self.to_tables())


def recipe_names() -> list[str]:
    """Return the names of the shipped recipes."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_recipe(name_or_path: str, overrides: Sequence[str] = ()) -> Recipe:
    """Load a shipped recipe or a `.toml` file and apply `--set KEY=VALUE`. Raises RecipeError.

    KEY is `seed`, `STAGE.field` or `model.SECTION.field`. A file names a preset with changes (`[model] preset`,
    `[model.set] "action.layers"`), or was written by `Recipe.to_toml`.
    """
    path = FOLDER / f"{name_or_path}.toml" if name_or_path in recipe_names() else Path(name_or_path)
    if path.suffix != ".toml":
        raise RecipeError(f"recipe {name_or_path!r}: expected one of {', '.join(recipe_names())}, or a .toml file")
    try:
        tables = read_toml(path, MAX_RECIPE_BYTES)
    except OSError as error:
        raise RecipeError(f"recipe {path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise RecipeError(f"recipe {path}: {error}") from error
    try:
        return recipe_of(tables, overrides)
    except (FieldError, ModelConfigError, RecipeError) as error:
        raise RecipeError(f"recipe {path}: {error}") from error


def recipe_of(tables: Mapping[str, object], overrides: Sequence[str] = ()) -> Recipe:
    """Build a recipe from its tables. Raises RecipeError, FieldError, ModelConfigError."""
    known = ("schema", "name", "seed", "model", "dagger", *STAGES)
    for key in tables:
        if key not in known:
            raise RecipeError(f"unknown key {key!r}; {near(key, known)}")
    if tables.get("schema") != SCHEMA:
        raise RecipeError(f"expected schema = {SCHEMA}, found {tables.get('schema')!r}")
    content: dict[str, Any] = {
        key: dict(value) if isinstance(value, Mapping) else value for key, value in tables.items()
    }
    kinds = {**STAGES, "dagger": DaggerConfig}
    for setting in overrides:
        _set(content, kinds, setting)
    stages: dict[str, Any] = {
        name: build(kind, filled(kind(), content.get(name, {})), f"[{name}]") for name, kind in kinds.items()
    }
    model = with_overrides(_model(content.get("model")), model_settings(overrides))
    name, seed = content.get("name"), content.get("seed")
    if not isinstance(name, str) or type(seed) is not int:
        raise RecipeError(f"expected a string as name and an integer as seed, found {name!r} and {seed!r}")
    return Recipe(name, seed, model, **stages)


def filled(default: object, table: object) -> object:
    """Fill missing keys of a table from `default`, in nested tables too: `optim.lr` alone changes nothing else."""
    if not isinstance(table, Mapping):
        return table
    whole = {**plain(default), **table}
    for name, value in table.items():
        own = getattr(default, str(name), None)
        if is_dataclass(own):
            whole[name] = filled(own, value)
    return whole


def stage_seed(recipe: Recipe, stage: str) -> int:
    """Derive a stage's seed from the run's seed; every stage has another one."""
    return int(np.random.default_rng((recipe.seed, crc32(stage.encode()))).integers(2**31))


def _model(table: object) -> TicVlaConfig:
    """Build the network's configuration from a preset with changes, or from a complete table."""
    if not isinstance(table, Mapping):
        raise RecipeError("expected a table [model] with preset")
    if "preset" not in table:
        return config_from_dict(dict(table))
    if extra := sorted(set(table) - {"preset", "set"}):
        raise RecipeError(f"[model]: unknown key {extra[0]!r}; expected preset and set")
    changes = table.get("set", {})
    if not isinstance(table["preset"], str) or not isinstance(changes, Mapping):
        raise RecipeError('[model]: expected preset = "NAME" and a table [model.set]')
    texts = {str(key): _as_text(value) for key, value in changes.items()}
    return with_overrides(config_for(table["preset"]), texts)


def _as_text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _set(content: dict[str, Any], kinds: Mapping[str, type], setting: str) -> None:
    """Store one `KEY=VALUE` in the tables as a value of its field's type."""
    key, equals, text = (part.strip() for part in setting.partition("="))
    where = f"--set {setting}"
    if not equals:
        raise RecipeError(f"{where}: expected KEY=VALUE")
    if key.startswith(MODEL_PREFIX):
        return
    if key in ("seed", "name"):
        content[key] = from_text(int if key == "seed" else str, text, where)
        return
    section, *path = key.split(".")
    if section not in kinds or not path:
        raise RecipeError(f"{where}: unknown key; {near(section, [*kinds, 'seed', 'model'])} as STAGE.field")
    kind: object = kinds[section]
    table = content.setdefault(section, {})
    if not isinstance(table, dict):
        raise RecipeError(f"[{section}]: expected a table, found {table!r}")
    for name in path[:-1]:
        kind = _fields_of(kind).get(name)
        below = table.get(name, {})
        if not isinstance(below, dict):
            raise RecipeError(f"{where}: {name} is a value ({below!r:.40}), so no key is expected below it")
        table[name] = dict(below)
        table = table[name]
    known = _fields_of(kind)
    if path[-1] not in known:
        raise RecipeError(f"{where}: unknown key {path[-1]!r}; {near(path[-1], known)}")
    table[path[-1]] = from_text(known[path[-1]], text, where)


def _fields_of(kind: object) -> Mapping[str, Any]:
    """Return the types of a dataclass's fields, or of the shares of a table `kinds`; empty for other types."""
    if get_origin(kind) is Mapping:
        return dict.fromkeys(KINDS, get_args(kind)[1])
    return field_types(kind) if isinstance(kind, type) and is_dataclass(kind) else {}
