"""What a target is made of: every section of `export/targets/*.toml` (schema 2) as a frozen, validated dataclass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edge.state.switches import Decoding, RecoverySwitch
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
RUNTIME_MOST = {"tick_period_ms": 60_000, "max_new_tokens": 8192, "prefill_chunk_tokens": 8192}
"""Largest values of [runtime] that still make sense; a larger one is a slip of the keyboard."""
MAX_FRAMES = 16
MAX_CORES = 1024


class TargetError(ValueError):
    """A target that is not known or whose file is wrong; its text is the one line to show."""


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise TargetError(message)


def _known(name: str, known: Mapping[str, object] | tuple[str, ...], what: str) -> None:
    _require(name in known, f"{what} {name!r} is not known; {near(name, known)}")


@dataclass(frozen=True)
class Figure:
    """A number with its source; modelled unless measured on the very device, with a relative error if one is known."""

    value: float
    source: str
    tag: str = MODELLED
    error: float | None = None
    """Half width of the error bar as a fraction of the value; None: the source gives none."""

    @classmethod
    def from_setting(cls, text: str, where: str) -> Figure:
        """A number of the command line; raises FieldError."""
        return cls(from_text(float, text, where), "set on the command line")

    def __post_init__(self) -> None:
        _require(0 <= self.value < 1e9, f"value {self.value} must be between 0 and 1e9")
        _require(bool(self.source.strip()), "source is empty: expected where the number comes from")
        _require(self.tag in (MODELLED, MEASURED), f"tag {self.tag!r} must be {MODELLED} or {MEASURED}")
        _require(self.error is None or 0 <= self.error < 1, f"error {self.error} must be between 0 and 1")


@dataclass(frozen=True)
class Device:
    """Memory that the model shares with everything else, and what the doctor recognises the board by."""

    memory_gib: float
    reserved_gib: float
    """Operating system, desktop and the robot's other programs."""
    source: str
    cores: int
    """Processor cores that graphs on the CPU share; the roofline's CPU figures are for all of them."""
    compute_capability: str | None = None
    min_l4t: str | None = None

    def __post_init__(self) -> None:
        _require(0 <= self.reserved_gib < self.memory_gib, f"reserved_gib {self.reserved_gib} must be below memory_gib")
        _require(self.cores >= 1, f"cores {self.cores} must be at least 1")


@dataclass(frozen=True)
class PowerMode:
    """One power mode of the board, found by its name."""

    compute: Figure
    """Compute roofs in this mode as a multiple of those of [roofline]."""
    memory: Figure
    """Memory bandwidth as a multiple of that of [roofline]."""
    busy_w: Figure | None = None
    """Power with everything busy."""
    reboot: bool = False
    """Switching to it needs a reboot."""

    def __post_init__(self) -> None:
        _require(self.compute.value > 0 and self.memory.value > 0, "compute and memory must be positive")


@dataclass(frozen=True)
class Power:
    """The budget, the mode that the plan is made for, and the meter that the governor reads."""

    mode: str
    modes: Mapping[str, PowerMode]
    meter: str
    rail: str | None = None
    budget_w: float | None = None
    """None: no budget (a development machine)."""
    idle_w: Figure | None = None

    def __post_init__(self) -> None:
        _known(self.mode, dict(self.modes), "power.mode")
        _known(self.meter, METERS, "power.meter")
        _require(self.budget_w is None or 0 < self.budget_w < 1000, f"budget_w {self.budget_w} must be 0 to 1000 W")
        if self.budget_w is not None:
            _require(self.idle_w is not None, "idle_w is missing: a budget cannot be planned for without it")
            lacking = [name for name, mode in self.modes.items() if mode.busy_w is None]
            _require(not lacking, f"modes {lacking} have no busy_w: a budget cannot be planned for without it")

    @property
    def selected(self) -> PowerMode:
        """The mode that `mode` names."""
        return self.modes[self.mode]


@dataclass(frozen=True)
class Roofline:
    """Peaks of the device in the mode that [power] names with compute = memory = 1, and how much of them is reached."""

    fp32_gflops: Figure
    fp16_gflops: Figure
    int8_gops: Figure
    memory_gbps: Figure
    compute_efficiency: Mapping[str, Figure]
    """Per stage, the share of the compute peak that its matrix products reach."""
    memory_efficiency: Figure
    sharing: str
    """`one-device`: both threads use one accelerator in turns; `own-cores`: each has cores, they share bandwidth."""
    tick_slowdown: Figure
    """Tick with reasoning running beside it, as a multiple of the tick alone (without waiting for a call in flight)."""
    generation_slowdown: Figure
    """Generation with control running beside it, as a multiple of the generation alone (without its turns)."""

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
        """Compute peak of a roof in GFLOP/s."""
        figure: Figure = {"fp32": self.fp32_gflops, "fp16": self.fp16_gflops, "int8": self.int8_gops}[roof]
        return figure


@dataclass(frozen=True)
class Compute:
    """Which roof a provider's kernels run under, by the precision of the weights; absent: it has no such kernel."""

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
        """Roof for weights of a precision, None if the provider has no kernel for it."""
        kind = "blocks" if block_size(precision) is not None else precision
        roof: str | None = getattr(self, kind)
        return roof


@dataclass(frozen=True)
class Provider:
    """An execution provider of ONNX Runtime and how it is opened."""

    name: str
    forms: tuple[str, ...]
    compute: Compute
    activation_bytes: int
    call_overhead_ms: Figure
    """Launching one call's kernels."""
    workspace_gib: Figure
    """Memory that the provider takes beyond weights, caches and activations."""
    engine: bool = False
    """It compiles an engine, which has to be built on the device before any run."""
    options: Mapping[str, str] = field(default_factory=dict)
    requires: Mapping[str, str] = field(default_factory=dict)
    """Package → version specifier."""
    index_url: str | None = None
    """Package index where those packages are, if not the usual one."""
    uses_cores: bool = False
    """Its speed depends on the graph's threads."""

    def __post_init__(self) -> None:
        _require(self.name.endswith("ExecutionProvider"), f"name {self.name!r} is not an ONNX Runtime provider's")
        for form in self.forms:
            _known(form, FORMS, "form")
        _require(self.activation_bytes in (2, 4), f"activation_bytes {self.activation_bytes} must be 2 or 4")


@dataclass(frozen=True)
class GraphPolicy:
    """How one graph is written, rounded and run."""

    provider: str
    form: str
    precision: str
    overrides: Mapping[str, str] = field(default_factory=dict)
    """Layer name pattern → precision; the first that matches wins."""
    candidates: tuple[str, ...] = ()
    """Precisions that the sensitivity search may choose from, from the most to the least exact."""
    threads: int | None = None
    """Intra-op threads; None: one, where it matters."""
    profile: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Free axis → (min, opt, max) lengths that an engine is built for."""

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
        """Precision of every layer."""
        return Precision(self.precision, tuple(self.overrides.items()))


@dataclass(frozen=True)
class GraphGate:
    """Thresholds of one graph's check against PyTorch; below a limit it fails, below `warn_cosine` it warns."""

    inputs: int
    min_cosine: float
    max_abs: float
    min_difference: float
    """Two different inputs must give outputs that differ by this much: a graph that ignores its input fails."""
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
    """Thresholds of what rounding does to the robot, worst case over the delays of the semantic state."""

    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    warn_waypoint_cm: float | None = None
    warn_heading_deg: float | None = None
    relative: float = 1.0
    """Mean deviation as a share of how much the model's own plans vary: at 1 nothing of them is left. Centimetres
    mean little for a model whose plans are short, as those of untrained weights are."""
    warn_relative: float = 0.5
    kv_cosine: float = 0.9
    """Least cosine of the semantic state to the exact one."""
    warn_kv_cosine: float = 0.97
    token_agreement: float = 0.1
    """Least share of the text before the first other token, for trained weights."""
    warn_token_agreement: float = 0.5
    min_semantic: float = 0.01
    """Least share of the plans' own spread that another semantic state has to move them by: below it, no figure here
    separates a language model that works from one that does not."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            _require(value is None or value > 0, f"{name} {value} must be positive")


@dataclass(frozen=True)
class RuntimePolicy:
    """Rates and lengths that the runner takes from the manifest, and what the plan must keep."""

    tick_period_ms: int
    max_new_tokens: int
    frame_offsets_s: tuple[float, ...]
    prefill_chunk_tokens: int
    kv_dtype: str
    max_delay_s: float
    """Ceiling on Δt, the age of the semantic state in use."""
    enforce_plan: bool
    """Whether a plan that does not fit stops the export."""
    control_cores: tuple[int, ...] = ()
    """Processor cores of the control thread; empty: the runner decides by those it finds."""
    reasoning_cores: tuple[int, ...] = ()
    control_priority: int = 50
    """Real-time priority of the control thread, 1 to 59; 0: none. The bridge's is above it."""
    decoding: str = Decoding.CONSTRAINED.value
    recovery: str = RecoverySwitch.ON.value
    """Defaults of the runner's switches (`edge/state/switches.py`)."""

    def __post_init__(self) -> None:
        for name, most in RUNTIME_MOST.items():
            value = getattr(self, name)
            _require(1 <= value <= most, f"{name} {value} must be 1 to {most}")
        count = len(self.frame_offsets_s)
        _require(1 <= count <= MAX_FRAMES, f"frame_offsets_s names {count} frames, expected 1 to {MAX_FRAMES}")
        _require(all(0 <= offset <= 60 for offset in self.frame_offsets_s), "frame_offsets_s must be 0 to 60 s")
        _known(self.kv_dtype, KV_DTYPES, "kv_dtype")
        _known(self.decoding, tuple(each.value for each in Decoding), "decoding")
        _known(self.recovery, tuple(each.value for each in RecoverySwitch), "recovery")
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
        _require(0 < self.max_delay_s <= 600, f"max_delay_s {self.max_delay_s} must be 0 to 600 s")


@dataclass(frozen=True)
class Measured:
    """One measurement that replaces the modelled time of exactly this model, graph, precision, form and provider."""

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
    """Prompt or context tokens it was taken at; None where time does not depend on them."""
    chunk_tokens: int | None = None
    """Prompt tokens a call, for prefill."""
    threads: int | None = None
    mode: str | None = None
    """Power mode it was taken in."""
    error: float | None = None
    energy_j: float | None = None
    """Energy above idle of what `ms` times, or of one token (edge-calib power); the governor starts from it."""

    def __post_init__(self) -> None:
        _require((self.ms is None) != (self.tokens_per_s is None), "give either ms or tokens_per_s")
        given = self.ms if self.ms is not None else self.tokens_per_s
        _require(given is not None and given > 0, "ms or tokens_per_s must be positive")
        _require(self.energy_j is None or 0 <= self.energy_j < 1e6, f"energy_j {self.energy_j} must be 0 to 1e6 J")
        _require(bool(self.machine.strip()), "machine is empty: expected where it was measured")
        _require(self.error is None or 0 <= self.error < 1, f"error {self.error} must be between 0 and 1")
