"""Who takes part, in which form, and what each of them computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

OURS = "ours"
OWN_STACK = frozenset({OURS, "genai", "onnxruntime"})
"""Ours is built on ONNX Runtime: it and GenAI are measured, but the bars are against the best of the others."""

TASKS = ("encoder", "action", "tick", "language")


@dataclass(frozen=True)
class Contender:
    """One process: a runtime (`stack`), its form, the parts it opens and the options it opens them with."""

    name: str
    stack: str
    parts: tuple[str, ...]
    options: Mapping[str, str] = field(default_factory=dict)
    assets: tuple[str, ...] = ()
    """What `tools.bench.peers.models.prepare` has to have made."""
    memory_only: bool = False
    """Started only to see how much memory all parts take together."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """What it is timed at."""
        if self.memory_only:
            return ()
        has = set(self.parts)
        return tuple(t for t in TASKS if t in has or (t == "tick" and {"encoder", "action"} <= has))


def _openvino(parts: Sequence[str], forms: Mapping[str, tuple[str, str]], name: str, **more: bool) -> Contender:
    options: dict[str, str] = {}
    for part in parts:
        form, hint = forms[part]
        options |= {f"{part}.form": form, f"{part}.INFERENCE_PRECISION_HINT": hint}
    assets = tuple(f"openvino/{part}-{forms[part][0]}" for part in parts)
    return Contender(name, "openvino", tuple(parts), options, assets, **more)


def _language(name: str, stack: str, form: str, **options: str) -> Contender:
    given = {"language.form": form} | {f"language.{k}": v for k, v in options.items()}
    folder = stack.partition("_")[0]
    assets = ("reference",) if stack == "torch" else (f"{folder}/language-{form}",)
    return Contender(name, stack, ("language",), given, assets)


def _torch(form: str, parts: tuple[str, ...], name: str, **more: bool) -> Contender:
    return Contender(name, "torch", parts, {f"{p}.form": form for p in parts}, ("reference",), **more)


CONTROL = ("encoder", "action")
EVERYTHING = ("encoder", "action", "language")

CONTENDERS = (
    Contender("ours control", OURS, CONTROL),
    Contender("ours language", OURS, ("language",)),
    Contender("ours everything", OURS, EVERYTHING, memory_only=True),
    _openvino(CONTROL, {"encoder": ("fp32", "bf16"), "action": ("fp32", "bf16")}, "openvino control bf16"),
    _openvino(CONTROL, {"encoder": ("int8", "bf16"), "action": ("int8", "bf16")}, "openvino control int8/bf16"),
    _openvino(CONTROL, {"encoder": ("int8", "f32"), "action": ("int8", "f32")}, "openvino control int8/f32"),
    _openvino(("language",), {"language": ("int8", "bf16")}, "openvino language int8/bf16"),
    _openvino(("language",), {"language": ("int8", "f32")}, "openvino language int8/f32"),
    _openvino(("language",), {"language": ("int4", "bf16")}, "openvino language int4/bf16"),
    _openvino(("language",), {"language": ("int4", "f32")}, "openvino language int4/f32"),
    *(
        _language(f"openvino genai {form}", "openvino_genai", form, INFERENCE_PRECISION_HINT="f32")
        for form in ("int8", "int4")
    ),
    _torch("bf16", CONTROL, "torch control bf16"),
    _torch("int8", CONTROL, "torch control int8"),
    _torch("fp32", ("action",), "torch action fp32"),
    _language("torch language bf16", "torch", "bf16"),
    _language("torch language int8", "torch", "int8"),
    _language("llama.cpp q4_0", "llama", "q4_0"),
    # Repacked weights are a copy beside the mapped file: reading the file, or not repacking, may be leaner.
    _language("llama.cpp q4_0 read", "llama", "q4_0", weights="read"),
    _language("llama.cpp q4_0 lean", "llama", "q4_0", extra_buffers="false"),
    _language("llama.cpp q8_0", "llama", "q8_0"),
    _language("genai int4", "genai", "int4"),
    *(
        Contender(
            f"onnxruntime action {form}",
            "onnxruntime",
            ("action",),
            {"action.form": form},
            (f"onnxruntime/action-{form}",),
        )
        for form in ("fp32", "int8")
    ),
    _openvino(
        EVERYTHING,
        {"encoder": ("int8", "bf16"), "action": ("int8", "bf16"), "language": ("int4", "bf16")},
        "openvino everything int8+int4",
        memory_only=True,
    ),
    _torch("bf16", EVERYTHING, "torch everything bf16", memory_only=True),
)


def chosen(patterns: Sequence[str]) -> list[Contender]:
    """Contenders whose name matches one of the patterns (all without patterns); raises ValueError when none does."""
    found = [c for c in CONTENDERS if not patterns or any(fnmatchcase(c.name, p) for p in patterns)]
    if not found:
        names = ", ".join(c.name for c in CONTENDERS)
        raise ValueError(f"--only {' '.join(patterns)}: no contender of that name; there are: {names}")
    return found
