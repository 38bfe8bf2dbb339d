"""The runner's settings from a manifest, every number within its range and in agreement with the others."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from edge.artifacts.files import MANIFEST_NAME, ArtifactError
from edge.state.switches import Decoding, RecoverySwitch, Speculation, Switches
from firmware_bridge.core.config import BRIDGE_PRIORITY

RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "image_px": (16, 2048),
    "frame_tokens": (1, 4096),
    "kv_dim": (1, 65536),
    "max_context": (32, 131072),
    "max_new_tokens": (1, 8192),
    "prefill_chunk_tokens": (1, 8192),
    "tick_period_ms": (20, 150),  # zero replaces a command that comes 200 ms after the last one (late_command.py)
    "step_s": (0.02, 0.5),
    "control_priority": (0, BRIDGE_PRIORITY - 1),
    **dict.fromkeys(("im_start_id", "im_end_id", "img_start_id", "img_end_id", "img_context_id"), (0, (1 << 20) - 1)),
}
"""Smallest and largest plausible value of each number; a value outside is a typing error or an attack."""
DELAY_S: Final = (0.1, 60.0)
"""Smallest and largest plausible `max_delay_s`, s: a robot leaves the place of its semantic state within a minute."""
BUDGET_W: Final = (0.1, 1000.0)
"""Smallest and largest plausible power budget, W."""
MAX_FRAMES: Final = 16
OLDEST_FRAME_S: Final = 60.0
MAX_CORES: Final = 1024
SPECIAL_TOKENS: Final[Mapping[str, str]] = {
    "im_start_id": "<|im_start|>",
    "im_end_id": "<|im_end|>",
    "img_start_id": "<img>",
    "img_end_id": "</img>",
    "img_context_id": "<IMG_CONTEXT>",
}
"""Setting of each special token's id, and the token."""
SHORTEST_TEXT_TOKENS: Final = 8
"""Fewest tokens of a prompt's text, beside frames and answer; the real prompt is measured when the model is opened."""
_SWITCHES: Final[Mapping[str, type[Decoding | RecoverySwitch | Speculation]]] = {
    "decoding": Decoding,
    "recovery": RecoverySwitch,
    "speculation": Speculation,
}
_LISTS: Final = ("frame_offsets_s", "control_cores", "reasoning_cores")
_FRACTIONS: Final = ("step_s",)
_TRAINED: Final[Mapping[str, tuple[str, str]]] = {
    "image_px": ("vision", "image_px"),
    "max_context": ("language", "max_context"),
    "step_s": ("action", "step_s"),
    **{name: ("language", name) for name in SPECIAL_TOKENS},
}
"""Settings that the network's configuration fixes: its section and key."""


@dataclass(frozen=True)
class RuntimeConfig:
    """The runner's settings from the manifest; raises ArtifactError."""

    image_px: int
    frame_tokens: int
    kv_dim: int
    max_context: int
    max_new_tokens: int
    prefill_chunk_tokens: int
    frame_offsets_s: tuple[float, ...]
    tick_period_ms: int
    step_s: float
    im_start_id: int
    im_end_id: int
    img_start_id: int
    img_end_id: int
    img_context_id: int
    control_cores: tuple[int, ...]
    """Processor cores of the control thread; empty: the runner chooses among the available ones."""
    reasoning_cores: tuple[int, ...]
    control_priority: int
    """Highest real-time priority of the runner's threads, below the bridge's; control has 1 less. 0: none."""
    decoding: Decoding = Decoding.CONSTRAINED
    recovery: RecoverySwitch = RecoverySwitch.ON
    speculation: Speculation = Speculation.ON
    """Default switches, which a command's options override; older manifests lack them."""

    @property
    def switches(self) -> Switches:
        """The default switches; standing at the goal is no setting of a manifest."""
        return Switches(self.decoding, self.recovery, False, self.speculation)

    def __post_init__(self) -> None:
        for name, (least, most) in RANGES.items():
            value = getattr(self, name)
            _require(least <= value <= most, f"{name} {value:g}, expected {least:g} to {most:g}{_advice(name)}")
        self._check_frames()
        for name in ("control_cores", "reasoning_cores"):
            cores = getattr(self, name)
            sound = len(set(cores)) == len(cores) and all(0 <= core < MAX_CORES for core in cores)
            _require(sound, f"{name} {list(cores)}, expected different cores from 0 to {MAX_CORES - 1}")
        both = sorted(set(self.control_cores) & set(self.reasoning_cores))
        _require(not both, f"cores {both} are in control_cores and in reasoning_cores")
        ids = [getattr(self, name) for name in SPECIAL_TOKENS]
        _require(len(set(ids)) == len(ids), f"special token ids {ids} are not distinct")

    def _check_frames(self) -> None:
        offsets, period_s = self.frame_offsets_s, self.tick_period_ms / 1e3
        _require(
            1 <= len(offsets) <= MAX_FRAMES and all(0 <= offset <= OLDEST_FRAME_S for offset in offsets),
            f"frame_offsets_s must be 1 to {MAX_FRAMES} offsets of 0 to {OLDEST_FRAME_S:.0f} s",
        )
        apart = all(later - earlier >= period_s for earlier, later in itertools.pairwise(offsets))
        _require(apart, f"frame_offsets_s {list(offsets)} must grow by a tick of {period_s:g} s or more")
        # The runner adds the newest frame to those above 0: without a 0 the prompt would have a frame too many.
        _require(offsets[0] == 0, f"frame_offsets_s {list(offsets)} must begin with 0, the newest frame")
        needed = len(offsets) * self.frame_tokens + SHORTEST_TEXT_TOKENS + self.max_new_tokens
        _require(
            needed <= self.max_context,
            f"max_context {self.max_context} is too short: {len(offsets)} frames of {self.frame_tokens} tokens, text "
            f"and an answer of {self.max_new_tokens} need {needed}",
        )


def read_runtime(section: Mapping[str, Any]) -> RuntimeConfig:
    """Read a manifest's `runtime` section; raises ArtifactError."""
    fields = RuntimeConfig.__dataclass_fields__
    if not set(fields) - set(_SWITCHES) <= set(section) <= set(fields):
        raise ArtifactError(f"{MANIFEST_NAME}: runtime has {sorted(section)}, expected {sorted(fields)}")
    lists = {key: section[key] for key in _LISTS}
    numbers = {key: value for key, value in section.items() if key not in (*lists, *_SWITCHES)}
    if not all(isinstance(values, list) and len(values) <= MAX_CORES for values in lists.values()) or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and 0 <= v < 1e6
        for v in [*numbers.values(), *(v for values in lists.values() for v in values)]
    ):
        raise ArtifactError(f"{MANIFEST_NAME}: runtime values must be numbers that are not negative")
    whole = [v for key, v in numbers.items() if key not in _FRACTIONS]
    whole += [*lists["control_cores"], *lists["reasoning_cores"]]
    _require(all(value == int(value) for value in whole), "counts, ids and cores must be whole numbers")
    values: dict[str, Any] = {key: value if key in _FRACTIONS else int(value) for key, value in numbers.items()}
    values |= {key: tuple((float if key == "frame_offsets_s" else int)(v) for v in lists[key]) for key in _LISTS}
    return RuntimeConfig(**values, **_switches(section))


def check_agreement(manifest: Mapping[str, Any], runtime: RuntimeConfig, steps: int) -> None:
    """Check the settings against the network's training, the plan and the device where a manifest records them.

    `steps`: length of the action expert's trajectory. Raises ArtifactError.
    """
    network = nested(manifest, "model", "config")
    for name, (section, key) in _TRAINED.items():
        trained = nested(network, section, key) if network is not None else None
        value = getattr(runtime, name)
        _require(trained in (None, value), f"{name} is {value}, the network was built for {trained}")
    trained = None if network is None else nested(network, "action", "steps")
    _require(trained in (None, steps), f"the trajectory has {steps} steps, the network was built for {trained}")
    period_ms = nested(manifest, "plan", "period_ms")
    _require(period_ms in (None, runtime.tick_period_ms), f"tick_period_ms is {runtime.tick_period_ms}, the plan's is "
             f"{period_ms}")  # fmt: skip
    cores = nested(manifest, "provenance", "target", "device", "cores")
    used = max((*runtime.control_cores, *runtime.reasoning_cores), default=0)
    if isinstance(cores, int):
        _require(used < cores, f"core {used} is used, the target has the cores 0 to {cores - 1}")
    check_plan(manifest)


def check_plan(manifest: Mapping[str, Any]) -> None:
    """Check a manifest's largest age of a semantic state and power budget, if any; raises ArtifactError."""
    target = nested(manifest, "provenance", "target")
    delay_s, budget_w = nested(manifest, "plan", "max_delay_s"), nested(target, "power", "budget_w")
    for name, value, (least, most) in (("max_delay_s", delay_s, DELAY_S), ("budget_w", budget_w, BUDGET_W)):
        sound = isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most
        if value is not None and not sound:
            raise ArtifactError(f"{MANIFEST_NAME}: {name} {value!r}, expected {least:g} to {most:g}; export again")
    asked_s = nested(target, "runtime", "max_delay_s")
    if delay_s is not None and asked_s not in (None, delay_s):
        raise ArtifactError(f"{MANIFEST_NAME}: max_delay_s is {delay_s}, the target's is {asked_s!r}; export again")


def nested(holder: Any, *keys: str) -> Any:
    """Return a nested value; None where a key is missing."""
    for key in keys:
        holder = holder.get(key) if isinstance(holder, Mapping) else None
    return holder


def _switches(section: Mapping[str, Any]) -> dict[str, Any]:
    """Read the switches of a runtime section; raises ArtifactError."""
    try:
        return {key: kind(section[key]) for key, kind in _SWITCHES.items() if key in section}
    except ValueError as error:
        known = {key: [each.value for each in kind] for key, kind in _SWITCHES.items()}
        raise ArtifactError(f"{MANIFEST_NAME}: runtime: {error}; expected {known}") from error


def _advice(name: str) -> str:
    if name != "control_priority":
        return ""
    return f", below the bridge's {BRIDGE_PRIORITY}: export again with --set runtime.control_priority=50"


def _require(sound: bool, message: str) -> None:
    if not sound:
        raise ArtifactError(f"{MANIFEST_NAME}: runtime: {message}")
