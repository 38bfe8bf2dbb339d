"""Targets as data: `export/targets/*.toml`, or a user's file with the same tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge.artifacts.manifest import LANGUAGE_PAIR, LANGUAGE_WHOLE
from export.core.typed import FieldError, SettingText, build, near, plain
from export.model.config import MODEL_PREFIX
from export.quantize.precision import Precision, block_size
from export.targets.sections import (
    Device,
    GraphGate,
    GraphPolicy,
    Measured,
    Power,
    Provider,
    Roofline,
    RuntimePolicy,
    TargetError,
    TaskGate,
)
from firmware_bridge.system.input_file import read_toml

SCHEMA = 2
TARGETS_DIR = Path(__file__).parent
TASK_GATE = "task"
OTHER_GRAPHS = ("vision_encoder", "semantic_context", "action_expert")
CHOOSING = (*LANGUAGE_WHOLE, LANGUAGE_PAIR[1])
"""Graphs with a next token."""
MODEL_SECTIONS = ("graphs", "gates", "runtime")
LEAVES = ("overrides", "profile", "options", "requires")
"""Tables whose keys may contain dots: layer patterns and option names."""
FIXED_KEYS = ("schema", "name", "measured", "models")


def graph_names(*, pair: bool) -> tuple[str, ...]:
    """Return the graphs' names in build order, with one language model or with a pair."""
    return ("vision_encoder", *(LANGUAGE_PAIR if pair else LANGUAGE_WHOLE), "semantic_context", "action_expert")


@dataclass(frozen=True)
class Target:
    """Device to export for."""

    name: str
    description: str
    arch: tuple[str, ...]
    device: Device
    power: Power
    roofline: Roofline
    graphs: Mapping[str, GraphPolicy]
    providers: Mapping[str, Provider]
    gates: Mapping[str, GraphGate]
    task_gate: TaskGate
    runtime: RuntimePolicy
    measured: tuple[Measured, ...] = ()
    models: Mapping[str, Any] = field(default_factory=dict)
    """Model name → its differing tables of graphs, gates and runtime; see `for_model`."""

    def __post_init__(self) -> None:
        names = set(self.graphs)
        language = set(LANGUAGE_WHOLE) if LANGUAGE_WHOLE[0] in names else set(LANGUAGE_PAIR)
        expected = {*OTHER_GRAPHS, *language}
        if names != expected:
            raise TargetError(
                f"graphs are {sorted(names)}: expected {sorted(OTHER_GRAPHS)} and either {LANGUAGE_WHOLE[0]} or the "
                f"pair {' and '.join(LANGUAGE_PAIR)}"
            )
        for name, graph in self.graphs.items():
            if graph.provider not in self.providers:
                raise TargetError(f"graphs.{name}.provider {graph.provider!r} is not in [providers]")
            self._check_provider(name, graph, self.providers[graph.provider])
            self.gate(name)
        wrong = sorted(set(self.gates) - expected - set(LANGUAGE_WHOLE))
        if wrong:
            raise TargetError(f"gates.{wrong[0]}: no such graph; {near(wrong[0], expected)}")
        for name, gate in self.gates.items():
            if gate.top1 is not None and name not in CHOOSING:
                raise TargetError(f"gates.{name}.top1: {name} chooses no token; expected it of {' or '.join(CHOOSING)}")
        for point in self.measured:
            if point.mode is not None and point.mode not in self.power.modes:
                raise TargetError(f"measured: mode {point.mode!r}: {near(point.mode, self.power.modes)}")

    @staticmethod
    def _check_provider(name: str, graph: GraphPolicy, provider: Provider) -> None:
        if graph.form not in provider.forms:
            raise TargetError(f"graphs.{name}.form {graph.form!r}: {provider.name} takes {', '.join(provider.forms)}")
        if graph.form == "plain" and name in (*LANGUAGE_WHOLE, *LANGUAGE_PAIR):
            raise TargetError(
                f"graphs.{name}.form 'plain': its attention extends KV buffers in place, expected 'fused'"
            )
        for precision in (graph.precision, *graph.overrides.values(), *graph.candidates):
            if provider.compute.roof(precision) is None:
                raise TargetError(f"graphs.{name}: {provider.name} has no kernel for precision {precision!r}")
            if graph.form == "plain" and block_size(precision) is not None:
                raise TargetError(f"graphs.{name}: the plain form has no {precision!r}, blocks need the form 'fused'")

    @property
    def graph_names(self) -> tuple[str, ...]:
        """Names of the graphs in build order."""
        return graph_names(pair=LANGUAGE_WHOLE[0] not in self.graphs)

    @property
    def half(self) -> bool:
        """Whether activations and KV buffers are fp16."""
        return self.runtime.kv_dtype == "fp16"

    def provider(self, graph: str) -> Provider:
        """Return the execution provider of a graph."""
        return self.providers[self.graphs[graph].provider]

    def precision(self, graph: str) -> Precision:
        """Return the target's precision of every layer of a graph."""
        return self.graphs[graph].precisions()

    def gate(self, graph: str) -> GraphGate:
        """Return the thresholds of a graph; `language_model` is the default for both graphs of a pair."""
        found = self.gates.get(graph)
        if found is None and graph in LANGUAGE_PAIR:
            found = self.gates.get(LANGUAGE_WHOLE[0])
            if found is not None and graph not in CHOOSING:
                found = dataclasses.replace(found, top1=None)
        if found is None:
            raise TargetError(f"gates.{graph} is missing: expected the thresholds of that graph")
        return found

    def session(self, graph: str, inputs: Sequence[Mapping[str, object]]) -> dict[str, Any]:
        """Return the manifest's `session` of a graph with these inputs (name, shape).

        Raises TargetError if an engine needs a profile of a free axis and has none.
        """
        policy, provider = self.graphs[graph], self.provider(graph)
        options = dict(provider.options)
        if provider.engine:
            options.update(_profile_options(graph, policy, inputs))
        return {"provider": provider.name, "options": options, "threads": policy.threads, "engine": provider.engine}

    def to_dict(self) -> dict[str, Any]:
        """Return the target as tables that `parse_target` reads."""
        content = plain(self)
        content["gates"][TASK_GATE] = content.pop("task_gate")
        return {"schema": SCHEMA, **content}


def _profile_options(graph: str, policy: GraphPolicy, inputs: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return TensorRT's explicit profiles; without them it rebuilds the engine at run time for every new shape."""
    shapes: dict[str, list[str]] = {"min": [], "opt": [], "max": []}
    for tensor in inputs:
        free = [axis for axis in tensor["shape"] if isinstance(axis, str)]
        missing = [axis for axis in free if axis not in policy.profile]
        if missing:
            raise TargetError(f"graphs.{graph}.profile.{missing[0]} is missing: {tensor['name']} is free along it")
        if free:
            for i, kind in enumerate(shapes):
                lengths = [policy.profile[axis][i] if isinstance(axis, str) else axis for axis in tensor["shape"]]
                shapes[kind].append(f"{tensor['name']}:{'x'.join(map(str, lengths))}")
    return {f"trt_profile_{kind}_shapes": ",".join(entries) for kind, entries in shapes.items() if entries}


def list_targets() -> list[str]:
    """Return the names of the shipped targets."""
    return sorted(path.stem for path in TARGETS_DIR.glob("*.toml"))


def load_target(name: str, model: str | None = None) -> Target:
    """Read a target by name or by the path of a TOML file, for a model if given. Raises TargetError."""
    own = name.endswith(".toml") or "/" in name
    if not own and name not in list_targets():
        names = ", ".join(list_targets())
        raise TargetError(f"target {name!r} is not known; expected one of: {names}, or the path of a .toml file")
    path = Path(name) if own else TARGETS_DIR / f"{name}.toml"
    try:
        content = read_toml(path)
    except OSError as error:
        raise TargetError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise TargetError(f"{path.name}: not TOML ({error})") from error
    target = parse_target(content, path.name)
    return target if model is None else for_model(target, model)


def parse_target(content: Mapping[str, object], where: str) -> Target:
    """Validate a target's tables; unknown keys, missing keys and wrong types are errors."""
    tables = dict(content)
    if tables.pop("schema", None) != SCHEMA:
        raise TargetError(f"{where}: schema must be {SCHEMA}")
    gates = tables.get("gates")
    if not isinstance(gates, Mapping) or TASK_GATE not in gates:
        raise TargetError(f"{where}: gates.{TASK_GATE} is missing: expected the thresholds of the task")
    tables["gates"] = {name: gate for name, gate in gates.items() if name != TASK_GATE}
    if "task_gate" in tables:
        raise TargetError(f"{where}: unknown key 'task_gate'; did you mean gates.{TASK_GATE}?")
    tables["task_gate"] = gates[TASK_GATE]
    try:
        target = build(Target, tables, where)
        for model, changes in target.models.items():
            for_model(dataclasses.replace(target, models={model: changes}), model, where)
    except FieldError as error:
        raise TargetError(str(error)) from error
    return target


def for_model(target: Target, model: str, where: str | None = None) -> Target:
    """Apply the changes that the target's file (`where` in errors) makes for a model. Raises TargetError."""
    changes = target.models.get(model)
    base = {**target.to_dict(), "models": {}}
    if changes is None:
        return parse_target(base, target.name)
    where = f"{where or target.name}: models.{model}"
    if not isinstance(changes, Mapping):
        raise TargetError(f"{where}: expected a table")
    for section in changes:
        if section not in MODEL_SECTIONS:
            raise TargetError(f"{where}: unknown key {section!r}; {near(section, MODEL_SECTIONS)}")
    graphs = changes.get("graphs", {})
    for given, replaced in ((LANGUAGE_WHOLE, LANGUAGE_PAIR), (LANGUAGE_PAIR, LANGUAGE_WHOLE)):
        if any(name in graphs for name in given):
            base["graphs"] = {k: v for k, v in base["graphs"].items() if k not in replaced}
            base["gates"] = {k: v for k, v in base["gates"].items() if k not in replaced or given == LANGUAGE_PAIR}
    return parse_target(_merged(base, changes), where)


def _merged(base: Mapping[str, object], changes: Mapping[str, object]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        # A list of overrides or candidates belongs to its precision: replace it, never merge it.
        if isinstance(value, Mapping) and isinstance(below, Mapping) and key not in ("overrides", "profile"):
            merged[key] = _merged(below, value)
        else:
            merged[key] = value
    return merged


def with_settings(target: Target, settings: Iterable[str]) -> Target:
    """Apply `key=value` settings (`--set`) with the fields' types. Raises TargetError that names similar keys.

    Settings of the network (`model.…`) are ignored. Setting a graph's precision disables the search for it.
    """
    content = target.to_dict()
    for setting in _expanded(settings):
        path, sign, text = (part.strip() for part in setting.partition("="))
        if not sign or not path:
            raise TargetError(f"--set {setting}: expected KEY=VALUE, e.g. --set power.mode=15W")
        if path.split(".")[0] in FIXED_KEYS:
            raise TargetError(f"--set {path}: cannot be set; write a target file of your own")
        for parts in _places(content, path.split(".")):
            _set(content, parts, SettingText(text), path)
    return parse_target(content, f"{target.name} with --set")


def _expanded(settings: Iterable[str]) -> Iterator[str]:
    for setting in settings:
        path = setting.partition("=")[0].strip()
        if path.startswith(MODEL_PREFIX):
            continue
        yield setting
        if path.startswith("graphs.") and path.endswith(".precision"):
            yield f"{path.removesuffix('precision')}candidates="


def _places(content: Mapping[str, Any], parts: list[str]) -> list[list[str]]:
    """Return the key paths of a dotted path; `language_model` is both graphs of a pair."""
    whole = len(parts) > 2 and parts[0] in ("graphs", "gates") and parts[1] == LANGUAGE_WHOLE[0]
    if whole and LANGUAGE_WHOLE[0] not in content[parts[0]] and parts[2] not in ("prefill", "decode"):
        halves = [name for name in LANGUAGE_PAIR if parts[2] != "top1" or name in CHOOSING]
        return [[parts[0], name, *parts[2:]] for name in halves]
    return [parts]


def _set(table: dict[str, Any], parts: list[str], text: SettingText, path: str) -> None:
    """Set a value below a table; its type is checked where the tables are built. Raises TargetError."""
    while True:
        # Graph names contain dots: take the longest prefix that is a key.
        ends = [end for end in range(len(parts), 0, -1) if ".".join(parts[:end]) in table]
        key, rest = ".".join(parts[: ends[0]]) if ends else parts[0], parts[ends[0] if ends else 1 :]
        if not rest:
            table[key] = text
            return
        if not ends and table and all(isinstance(value, dict) for value in table.values()):
            raise TargetError(f"--set {path}: unknown key {key!r}; {near(key, table)}")
        below = table.setdefault(key, {})
        if not isinstance(below, dict):
            raise TargetError(f"--set {path}: {key} is not a table")
        if key in LEAVES:
            below[".".join(rest)] = text
            return
        table, parts = below, rest
