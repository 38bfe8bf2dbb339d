"""Sections of a target file (`export/targets/*.toml`, schema 2) as frozen, validated dataclasses."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

from edge.artifacts.runtime import BUDGET_W, DELAY_S, MAX_CORES, MAX_FRAMES, OLDEST_FRAME_S, RANGES
from edge.state.switches import Decoding, RecoverySwitch, Speculation
from export.core.typed import from_text, near
from export.quantize.precision import PRECISIONS, Precision, block_size
from firmware_bridge.core.config import BRIDGE_PRIORITY

MODELLED, MEASURED = "modelled", "measured"
FORMS = ("fused", "plain")
"""`fused`: ONNX Runtime's own fused operators; `plain`: standard ONNX operators only (TensorRT, OpenVINO)."""
ROOFS = ("fp32", "fp16", "int8")
KV_DTYPES = {"fp32": 4, "fp16": 2}
METERS = ("ina3221", "nvml", "rapl", "none")
STAGES = ("vision_encoder", "prefill", "decode", "semantic_context", "action_expert")
SHARING = ("one-device", "own-cores")
RUNTIME_NUMBERS = ("tick_period_ms", "max_new_tokens", "prefill_chunk_tokens")
"""Numbers of [runtime] whose ranges are those of the runner."""


class TargetError(ValueError):
    """Unknown target or invalid target file; its text is the one line to show."""


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise TargetError(message)


def _known(name: str, known: Mapping[str, object] | tuple[str, ...], what: str) -> None:
    if name not in known:
        raise TargetError(f"{what} {name!r} is not known; {near(name, known)}")


@dataclass(frozen=True)
class Figure:
    """Number with its source; modelled unless measured on this device, with a relative error if known."""

    value: float
    source: str
    tag: str = MODELLED
    error: float | None = None
    """Half width of the error bar as a fraction of the value; None if the source has none."""

    @classmethod
    def from_setting(cls, text: str, where: str) -> Figure:
        """Convert a number of the command line. Raises FieldError."""
        return cls(from_text(float, text, where), "set on the command line")

    def __post_init__(self) -> None:
        _require(0 <= self.value < 1e9, f"value {self.value} must be between 0 and 1e9")
        _require(bool(self.source.strip()), "source is empty: expected the number's source")
        _require(self.tag in (MODELLED, MEASURED), f"tag {self.tag!r} must be {MODELLED} or {MEASURED}")
        _require(self.error is None or 0 <= self.error < 1, f"error {self.error} must be between 0 and 1")


@dataclass(frozen=True)
class Device:
    """Memory shared by model and other programs, and the board's identification for the doctor."""

    memory_gib: float
    reserved_gib: float
    """Memory of operating system, desktop and the robot's other programs, GiB."""
    source: str
    cores: int
    """Processor cores shared by graphs on the CPU; the roofline's CPU figures are for all of them."""
    compute_capability: str | None = None
    min_l4t: str | None = None

    def __post_init__(self) -> None:
        _require(0 <= self.reserved_gib < self.memory_gib, f"reserved_gib {self.reserved_gib} must be below memory_gib")
        _require(self.cores >= 1, f"cores {self.cores} must be at least 1")


@dataclass(frozen=True)
class PowerMode:
    """Power mode of the board, identified by name."""

    compute: Figure
    """Compute roofs in this mode as a multiple of those of [roofline]."""
    memory: Figure
    """Memory bandwidth as a multiple of that of [roofline]."""
    busy_w: Figure | None = None
    """Power under full load, W."""
    reboot: bool = False
    """Whether switching to it needs a reboot."""

    def __post_init__(self) -> None:
        _require(self.compute.value > 0 and self.memory.value > 0, "compute and memory must be positive")


@dataclass(frozen=True)
class Power:
    """Power budget, the plan's power mode, and the governor's meter."""

    mode: str
    modes: Mapping[str, PowerMode]
    meter: str
    rail: str | None = None
    budget_w: float | None = None
    """Budget, W; None on a development machine."""
    idle_w: Figure | None = None

    def __post_init__(self) -> None:
        _known(self.mode, dict(self.modes), "power.mode")
        _known(self.meter, METERS, "power.meter")
        least_w, most_w = BUDGET_W
        _require(
            self.budget_w is None or least_w <= self.budget_w <= most_w,
            f"budget_w {self.budget_w} must be {least_w:g} to {most_w:g} W",
        )
        if self.budget_w is not None:
            _require(self.idle_w is not None, "idle_w is missing: a budget cannot be planned for without it")
            lacking = [name for name, mode in self.modes.items() if mode.busy_w is None]
            _require(not lacking, f"modes {lacking} have no busy_w: a budget cannot be planned for without it")

    @property
    def selected(self) -> PowerMode:
        """The power mode named `mode`."""
        return self.modes[self.mode]


@dataclass(frozen=True)
class Roofline:
    """Peaks of the device in the power mode with compute = memory = 1, and the reachable shares."""

    fp32_gflops: Figure
    fp16_gflops: Figure
    int8_gops: Figure
    memory_gbps: Figure
    compute_efficiency: Mapping[str, Figure]
    """Stage → reached share of the compute peak in its matrix products."""
    memory_efficiency: Figure
    sharing: str
    """`one-device`: both threads use one accelerator in turns; `own-cores`: each has cores, they share bandwidth."""
    tick_slowdown: Figure
    """Tick while reasoning runs, as a multiple of the tick alone (without waiting for a call in flight)."""
    generation_slowdown: Figure
    """Generation while control runs, as a multiple of the generation alone (without waiting for control)."""

    def __post_init__(self) -> None:
        for name in ("fp32_gflops", "fp16_gflops", "int8_gops", "memory_gbps"):
            _require(getattr(self, name).value > 0, f"{name} must be positive")
        for stage in self.compute_efficiency:
            _known(stage, STAGES, "compute_efficiency of stage")
        missing = sorted(set(STAGES) - set(self.compute_efficiency))
        _require(not missing, f"compute_efficiency lacks {missing}")
        for figure in (*self.compute_efficiency.values(), self.memory_efficiency):
            _require(0 < figure.value <= 1, f"an efficiency of {figure.value} is not above 0 and at most 1")
        _known(self.sharing, SHARING, "sharing")
        for name in ("tick_slowdown", "generation_slowdown"):
            _require(getattr(self, name).value >= 1, f"{name} must be at least 1")

    def peak(self, roof: str) -> Figure:
        """Return the compute peak of a roof, GFLOP/s."""
        figure: Figure = {"fp32": self.fp32_gflops, "fp16": self.fp16_gflops, "int8": self.int8_gops}[roof]
        return figure


@dataclass(frozen=True)
class Compute:
    """Roof of a provider's kernels by precision of the weights; absent if it has no such kernel."""

    attention: str
    fp32: str | None = None
    fp16: str | None = None
    int8: str | None = None
    blocks: str | None = None

    def __post_init__(self) -> None:
        for name in ("attention", "fp32", "fp16", "int8", "blocks"):
            roof = getattr(self, name)
            if roof is not None:
                _known(roof, ROOFS, f"compute.{name}")

    def roof(self, precision: str) -> str | None:
        """Return the roof for a precision of the weights; None if the provider has no kernel for it."""
        kind = "blocks" if block_size(precision) is not None else precision
        roof: str | None = getattr(self, kind)
        return roof


@dataclass(frozen=True)
class Provider:
    """Execution provider of ONNX Runtime with its options."""

    name: str
    forms: tuple[str, ...]
    compute: Compute
    activation_bytes: int
    call_overhead_ms: Figure
    """Time to launch a call's kernels."""
    workspace_gib: Figure
    """Memory of the provider beyond weights, caches and activations."""
    engine: bool = False
    """Whether it compiles an engine, which must be built on the device before a run."""
    options: Mapping[str, str] = field(default_factory=dict)
    requires: Mapping[str, str] = field(default_factory=dict)
    """Package → version specifier."""
    index_url: str | None = None
    """Package index of those packages, if not the default."""
    uses_cores: bool = False
    """Whether its speed depends on the graph's threads."""

    def __post_init__(self) -> None:
        _require(self.name.endswith("ExecutionProvider"), f"name {self.name!r} is not an ONNX Runtime provider's")
        for form in self.forms:
            _known(form, FORMS, "form")
        _require(self.activation_bytes in (2, 4), f"activation_bytes {self.activation_bytes} must be 2 or 4")


@dataclass(frozen=True)
class GraphPolicy:
    """How to write, round and run one graph."""

    provider: str
    form: str
    precision: str
    overrides: Mapping[str, str] = field(default_factory=dict)
    """Layer name pattern → precision; the first match applies."""
    candidates: tuple[str, ...] = ()
    """Candidates of the sensitivity search, from the most to the least exact."""
    threads: int | None = None
    """Intra-op threads; None: one, if the provider uses threads."""
    profile: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Free axis → (min, opt, max) lengths of an engine."""

    def __post_init__(self) -> None:
        _known(self.form, FORMS, "form")
        for name in (self.precision, *self.overrides.values(), *self.candidates):
            _known(name, PRECISIONS, "precision")
        order = [PRECISIONS.index(name) for name in self.candidates]
        _require(order == sorted(set(order)), f"candidates {list(self.candidates)} must go from most to least exact")
        _require(self.threads is None or 1 <= self.threads <= 256, f"threads {self.threads} must be 1 to 256")
        for axis, lengths in self.profile.items():
            _require(
                len(lengths) == 3 and 1 <= lengths[0] <= lengths[1] <= lengths[2],
                f"profile {axis} is {list(lengths)}: expected [min, opt, max] lengths",
            )

    def precisions(self) -> Precision:
        """Return the precision of every layer."""
        return Precision(self.precision, tuple(self.overrides.items()))


@dataclass(frozen=True)
class GraphGate:
    """Thresholds of one graph's comparison with PyTorch; below a limit it fails, below `warn_cosine` it warns."""

    inputs: int
    min_cosine: float
    max_abs: float
    min_difference: float
    """Smallest difference between the outputs of two different inputs: a graph that ignores its input fails."""
    warn_cosine: float | None = None
    top1: float | None = None
    """Least share of positions with the same most likely token."""

    def __post_init__(self) -> None:
        _require(2 <= self.inputs <= 1000, f"inputs {self.inputs} must be 2 to 1000")
        _require(-1 <= self.min_cosine <= 1, f"min_cosine {self.min_cosine} must be -1 to 1")
        _require(
            self.warn_cosine is None or self.min_cosine <= self.warn_cosine <= 1,
            f"warn_cosine {self.warn_cosine} must be between min_cosine and 1",
        )
        _require(self.top1 is None or 0 <= self.top1 <= 1, f"top1 {self.top1} must be 0 to 1")
        _require(self.max_abs > 0 and self.min_difference >= 0, "max_abs must be positive, min_difference not negative")


@dataclass(frozen=True)
class TaskGate:
    """Thresholds of the task error, worst case over the delays of the semantic state."""

    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    warn_waypoint_cm: float | None = None
    warn_heading_deg: float | None = None
    relative: float = 1.0
    """Largest mean deviation as a share of the spread of the model's plans; at 1 the plans are lost. Centimetres are
    a weak measure for short plans, such as those of untrained weights."""
    warn_relative: float = 0.5
    kv_cosine: float = 0.9
    """Smallest cosine of the semantic state to the exact one."""
    warn_kv_cosine: float = 0.97
    token_agreement: float = 0.1
    """Smallest share of the text before the first different token, for trained weights."""
    warn_token_agreement: float = 0.5
    min_semantic: float = 0.01
    """Smallest change of the plans by another semantic state, as a share of their spread: below it the task error
    cannot detect a broken language model."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            _require(value is None or value > 0, f"{name} {value} must be positive")


@dataclass(frozen=True)
class RuntimePolicy:
    """Rates and lengths that the runner reads from the manifest, and limits of the plan."""

    tick_period_ms: int
    max_new_tokens: int
    frame_offsets_s: tuple[float, ...]
    prefill_chunk_tokens: int
    kv_dtype: str
    max_delay_s: float
    """Largest Δt, the age of the semantic state in use, s."""
    enforce_plan: bool
    """Whether the export refuses a plan that does not fit."""
    control_cores: tuple[int, ...] = ()
    """Processor cores of the control thread; empty: the runner chooses."""
    reasoning_cores: tuple[int, ...] = ()
    control_priority: int = 50
    """Highest real-time priority of the runner's threads, 1 to 59, below the bridge's; control has 1 less. 0: none."""
    decoding: str = Decoding.CONSTRAINED.value
    recovery: str = RecoverySwitch.ON.value
    speculation: str = Speculation.ON.value
    """Defaults of the runner's switches (`edge/state/switches.py`)."""

    def __post_init__(self) -> None:
        for name in RUNTIME_NUMBERS:
            value, (least, most) = getattr(self, name), RANGES[name]
            _require(least <= value <= most, f"{name} {value} must be {least} to {most}")
        count = len(self.frame_offsets_s)
        _require(1 <= count <= MAX_FRAMES, f"frame_offsets_s names {count} frames, expected 1 to {MAX_FRAMES}")
        _require(
            all(0 <= offset <= OLDEST_FRAME_S for offset in self.frame_offsets_s),
            f"frame_offsets_s must be 0 to {OLDEST_FRAME_S:.0f} s",
        )
        period_s = self.tick_period_ms / 1e3
        _require(
            all(later - earlier >= period_s for earlier, later in itertools.pairwise(self.frame_offsets_s)),
            f"frame_offsets_s {list(self.frame_offsets_s)} must grow by a tick of {period_s:g} s or more",
        )
        _require(
            self.frame_offsets_s[0] == 0,
            f"frame_offsets_s {list(self.frame_offsets_s)} must begin with 0, the newest frame",
        )
        _known(self.kv_dtype, KV_DTYPES, "kv_dtype")
        _known(self.decoding, tuple(each.value for each in Decoding), "decoding")
        _known(self.recovery, tuple(each.value for each in RecoverySwitch), "recovery")
        _known(self.speculation, tuple(each.value for each in Speculation), "speculation")
        for name in ("control_cores", "reasoning_cores"):
            cores = getattr(self, name)
            _require(all(0 <= core < MAX_CORES for core in cores), f"{name} {list(cores)} must be 0 to {MAX_CORES - 1}")
        both = sorted(set(self.control_cores) & set(self.reasoning_cores))
        _require(not both, f"cores {both} are in control_cores and in reasoning_cores")
        _require(
            0 <= self.control_priority < BRIDGE_PRIORITY,
            f"control_priority {self.control_priority} must be 0 to {BRIDGE_PRIORITY - 1}, below the bridge's "
            f"{BRIDGE_PRIORITY}",
        )
        least_s, most_s = DELAY_S
        _require(
            least_s <= self.max_delay_s <= most_s, f"max_delay_s {self.max_delay_s} must be {least_s:g} to {most_s:g} s"
        )


@dataclass(frozen=True)
class Measured:
    """Measurement that replaces the modelled time of this model, graph, precision, form and provider."""

    model: str
    graph: str
    precision: str
    form: str
    provider: str
    machine: str
    date: str
    ms: float | None = None
    tokens_per_s: float | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    tokens: int | None = None
    """Prompt or context tokens of the measurement; None if time does not depend on them."""
    chunk_tokens: int | None = None
    """Prompt tokens per call, for prefill."""
    threads: int | None = None
    mode: str | None = None
    """Power mode of the measurement."""
    error: float | None = None
    energy_j: float | None = None
    """Energy above idle of the timed call, or of one token, J (edge-calib power); the governor's initial value."""

    def __post_init__(self) -> None:
        _require((self.ms is None) != (self.tokens_per_s is None), "give either ms or tokens_per_s")
        given = self.ms if self.ms is not None else self.tokens_per_s
        _require(given is not None and given > 0, "ms or tokens_per_s must be positive")
        _require(self.energy_j is None or 0 <= self.energy_j < 1e6, f"energy_j {self.energy_j} must be 0 to 1e6 J")
        _require(bool(self.machine.strip()), "machine is empty: expected the name of the measured machine")
        _require(self.error is None or 0 <= self.error < 1, f"error {self.error} must be between 0 and 1")
