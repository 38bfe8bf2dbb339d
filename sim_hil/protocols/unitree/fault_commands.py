"""Table of the faults that `edge-hil --faults` can inject, with parameters, and parser of fault requests."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

L2_B: Final = 0x220  # bits of WirelessController_.keys: R1 L1 start select R2 L2 F1 F2 A B X Y up right down left
CLEAR: Final = "clear"
MAX_LINE_BYTES: Final = 2000

Value = float | str
Range = tuple[float, float]


class FaultCommandError(ValueError):
    """An invalid fault request; one line: what, expected, found."""


@dataclass(frozen=True)
class FaultKind:
    """One fault: the component that causes it, its description, and its parameters as (default, range).

    A text parameter has a list of allowed texts instead of a range. `once`: switching the fault off has no effect.
    """

    where: str
    description: str
    numbers: Mapping[str, tuple[float, Range]] = field(default_factory=dict)
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # the first is the default
    once: bool = False


_SECONDS: Final = (0.0, 60.0)
KINDS: Final[Mapping[str, FaultKind]] = MappingProxyType(
    {
        "camera-stop": FaultKind("camera", "requests for an image are never answered"),
        "camera-freeze": FaultKind("camera", "every answer repeats the first image since then"),
        "camera-stale-buffers": FaultKind(
            "camera",
            "the newest images are repeated in turn, as many as there are buffers",
            {"buffers": (2.0, (2, 32))},
        ),
        "camera-frozen-clock": FaultKind("camera", "the first image since then with a running clock drawn into it"),
        "camera-frozen-noise": FaultKind(
            "camera", "the first image since then with new sensor noise, encoded again as JPEG"
        ),
        "camera-stale": FaultKind("camera", "every answer is the image of delay_s ago", {"delay_s": (1.0, _SECONDS)}),
        "camera-slow": FaultKind("camera", "every answer comes delay_s late", {"delay_s": (1.0, _SECONDS)}),
        "camera-half-rate": FaultKind("camera", "images come at rate_hz at most", {"rate_hz": (5.0, (0.1, 60))}),
        "camera-black": FaultKind("camera", "the lens is covered: sensor noise only"),
        "camera-saturated": FaultKind("camera", "the camera is blinded by a lamp: white with noise"),
        "camera-torn": FaultKind(
            "camera", "every JPEG ends after a share of its bytes", {"share": (0.5, (0.01, 0.99))}
        ),
        "camera-wrong-size": FaultKind(
            "camera", "images of another size", {"width": (160.0, (16, 4096)), "height": (160.0, (16, 4096))}
        ),
        "odometry-jump": FaultKind(
            "state",
            "the pose jumps by a step and keeps that offset",
            {"dx_m": (1.0, (-100, 100)), "dy_m": (0.0, (-100, 100)), "dtheta_rad": (0.0, (-3.2, 3.2))},
            once=True,
        ),
        "odometry-freeze": FaultKind(
            "state",
            "the pose freezes; the velocity freezes or reads zero; the robot's stamp continues or freezes",
            {},
            {"velocity": ("held", "zero"), "stamp": ("runs", "frozen")},
        ),
        "odometry-nan": FaultKind(
            "state", "a field is NaN, or the quaternion is zero", {}, {"field": ("position", "velocity", "rpy")}
        ),
        "odometry-lag": FaultKind("state", "the sport state comes delay_s late", {"delay_s": (0.3, _SECONDS)}),
        "odometry-bias": FaultKind("state", "the velocity reads dv_mps too high", {"dv_mps": (1.0, (-10, 10))}),
        "state-silent": FaultKind("state", "no state is sent on any topic"),
        "state-loss": FaultKind("state", "a share of the state messages is lost", {"percent": (50.0, (0, 100))}),
        "state-reorder": FaultKind("state", "neighbouring sport states are swapped"),
        "state-duplicate": FaultKind("state", "every sport state is sent twice"),
        "tip-over": FaultKind(
            "state", "the attitude reads as tilted", {"roll_rad": (0.0, (-3.2, 3.2)), "pitch_rad": (0.7, (-1.6, 1.6))}
        ),
        "low-battery": FaultKind("state", "the battery reads nearly empty", {"soc_percent": (5.0, (0, 100))}),
        "error-code": FaultKind("state", "the robot reports an error", {"code": (1001.0, (0, 2**32 - 1))}),
        "wrong-mode": FaultKind("state", "the robot reports another mode", {"mode": (7.0, (0, 255))}),
        "remote-keys": FaultKind("remote", "keys are held down on the remote", {"keys": (float(L2_B), (0, 65535))}),
        "remote-stick": FaultKind("remote", "a stick is pushed on the remote", {"ly": (0.6, (-1, 1))}),
        "stop-unanswered": FaultKind(
            "sport", "a StopMove is obeyed but answered delay_s later", {"delay_s": (10.0, _SECONDS)}
        ),
        "late-move": FaultKind(
            "sport",
            "one Move is held back until delay_s after the next StopMove",
            {"delay_s": (0.2, _SECONDS)},
            once=True,
        ),
        "deaf": FaultKind("sport", "requests of the sport service are lost"),
    }
)


@dataclass(frozen=True)
class FaultCommand:
    """Parsed request that switches a fault on or off, with all parameters; `CLEAR` switches everything off."""

    fault: str
    on: bool
    values: Mapping[str, Value]

    def number(self, name: str) -> float:
        """Return a numeric parameter."""
        return float(self.values[name])

    def text(self, name: str) -> str:
        """Return a text parameter."""
        return str(self.values[name])

    def line(self) -> bytes:
        """Return the line that `parse` turns into this request."""
        return json.dumps({"fault": self.fault, "on": self.on, **self.values}).encode()


def parse(line: bytes) -> FaultCommand:
    """Parse a line such as {"fault": "odometry-lag", "on": true, "delay_s": 0.3}. Raises FaultCommandError."""
    if len(line) > MAX_LINE_BYTES:
        raise FaultCommandError(f"expected at most {MAX_LINE_BYTES} bytes, found {len(line)}")
    try:
        table = json.loads(line)
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise FaultCommandError(f"expected a JSON object, found {line[:60]!r}")
    name, on = table.pop("fault", None), table.pop("on", True)
    if name == CLEAR and not table:
        return FaultCommand(CLEAR, False, {})
    if not isinstance(name, str) or name not in KINDS or not isinstance(on, bool):
        raise FaultCommandError(f"expected on or off of one of {', '.join(KINDS)}, found fault {name!r}, on {on!r}")
    return FaultCommand(name, on, _values(name, KINDS[name], table))


def _values(name: str, kind: FaultKind, table: dict[str, object]) -> dict[str, Value]:
    for key in table:
        if key not in kind.numbers and key not in kind.texts:
            known = ", ".join((*kind.numbers, *kind.texts)) or "no parameter"
            raise FaultCommandError(f"{name}: expected {known}, found {key!r}")
    values: dict[str, Value] = {}
    for key, (default, (low, high)) in kind.numbers.items():
        value = table.get(key, default)
        # Compared before conversion: an integer may exceed the range of a float, and NaN lies in no range.
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not low <= value <= high:
            raise FaultCommandError(f"{name}.{key}: expected {low:g} to {high:g}, found {value!r}")
        values[key] = float(value)
    for key, choices in kind.texts.items():
        text = table.get(key, choices[0])
        if text not in choices:
            raise FaultCommandError(f"{name}.{key}: expected one of {', '.join(choices)}, found {text!r}")
        values[key] = str(text)
    return values
