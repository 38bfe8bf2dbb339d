"""Posture of a person's limbs from a render row: walking, standing, sitting, talking, on the phone.

Angles are pitches about the body's left axis, rad: positive tips what hangs down backwards and what stands up forwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, cos, pi, sin

from sim_hil.simulation.person_meshes import ANKLE_M, SHIN_M, THIGH_M

_STANCE = 0.6  # share of a cycle that a foot is on the ground
_FULL_STEP_M = 0.71  # of a swing of 1
_SWING_KNEE_RAD, _ARM_RAD = 1.0, 0.5
_TOE_M, _HEEL_M = 0.16, 0.08  # from the ankle
_SEATED_THIGH_RAD = -1.45


@dataclass(frozen=True)
class Limbs:
    """Pitches of every part, rad, right side first, and the height of the hips over the ground, m (before scaling)."""

    hips_m: float
    trunk: float
    head: float
    thighs: tuple[float, float]
    shins: tuple[float, float]
    upper_arms: tuple[float, float]
    forearms: tuple[float, float]


def limbs(phase: float, swing: float, sitting: float, gesture: int) -> Limbs:
    """Return the posture for a gait phase 0..1, a swing (relative step length), sitting 0..1 and a gesture."""
    right, left = _leg(phase, swing), _leg((phase + 0.5) % 1.0, swing)
    thighs = tuple(hip + (_SEATED_THIGH_RAD - hip) * sitting for hip, _ in (right, left))
    shins = tuple((hip + knee) * (1.0 - sitting) for hip, knee in (right, left))
    reach = max(_reach(thigh, shin) for thigh, shin in zip(thighs, shins, strict=True))
    upper, fore = _arms(phase, swing, sitting, gesture)
    nod = 0.42 if gesture == 2 else 0.06 * sin(4 * pi * phase) if gesture == 1 else 0.0
    return Limbs(
        hips_m=reach,
        trunk=0.05 * swing - 0.08 * sitting,
        head=nod,
        thighs=(thighs[0], thighs[1]),
        shins=(shins[0], shins[1]),
        upper_arms=upper,
        forearms=fore,
    )


def _leg(phase: float, swing: float) -> tuple[float, float]:
    """Return hip pitch and knee bend of a leg whose foot touches down at phase 0."""
    # During stance the foot moves backwards at the body's speed, so it does not slide.
    most = asin(min(_STANCE * _FULL_STEP_M * swing / (THIGH_M + SHIN_M), 0.9))
    if phase < _STANCE:
        share = phase / _STANCE
        return most * (2.0 * share - 1.0), 0.04 + 0.12 * swing * sin(pi * share) ** 2
    share = (phase - _STANCE) / (1.0 - _STANCE)
    hip = most * cos(pi * share) - 0.12 * swing * sin(pi * share)
    return hip, 0.04 + _SWING_KNEE_RAD * swing * sin(pi * min(share * 1.15, 1.0)) ** 1.3


def _reach(thigh: float, shin: float) -> float:
    """From the hip down to the lowest point of the shoe, m; a toe may dip a little: shoes bend."""
    toe = _TOE_M * sin(shin) if shin > 0 else -_HEEL_M * sin(shin)
    return THIGH_M * cos(thigh) + SHIN_M * cos(shin) + ANKLE_M * cos(shin) + 0.4 * toe


def _arms(phase: float, swing: float, sitting: float, gesture: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Pitches of upper arms and forearms, right side first: each swings with the other side's leg."""
    uppers, fores = [], []
    for side in (0, 1):
        beat = cos(2 * pi * (phase + (0.5 if side == 0 else 0.0)))
        upper = -_ARM_RAD * swing * beat - 0.05
        fore = upper - 0.18 - 0.28 * swing * (1.0 + 0.6 * beat)
        upper += (-0.35 - upper) * sitting
        fore += (-1.35 - fore) * sitting
        if gesture == 2 and side == 0:
            upper, fore = -0.5, -2.15
        elif gesture == 1:
            wave = sin(2 * pi * phase + (0.0 if side == 0 else 1.9))
            raised = 1.0 if side == 0 else 0.45
            upper, fore = -0.15 * raised + 0.08 * wave, -1.35 * raised - 0.35 * wave * raised
        uppers.append(upper)
        fores.append(fore)
    return (uppers[0], uppers[1]), (fores[0], fores[1])
