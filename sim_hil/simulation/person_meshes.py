"""Parts of a person's body as meshes: trunk, head, limbs and clothes, each in the frame of its own joint.

Proportions are those of an average adult of 1.72 m (Winter, Biomechanics and Motor Control of Human Movement, table of
segment lengths by height); a look scales them and the width of the body.
"""

from __future__ import annotations

from sim_hil.crowd.looks import Appearance, Rgb
from sim_hil.world.drawing.mesh import Frame, MeshBuilder

# Joint heights of a standing body, m, and how far from the middle plane.
HIP_M, SHOULDER_M, NECK_M = 0.91, 1.385, 1.47
HIP_SIDE_M, SHOULDER_SIDE_M = 0.09, 0.195
THIGH_M, SHIN_M, ANKLE_M, UPPER_ARM_M, FOREARM_M = 0.42, 0.415, 0.075, 0.30, 0.25
Ring = tuple[float, float, float]  # height, half depth, half width
_SIDE_SHARE = {"vest": 1.08, "jacket": 1.08, "coat": 1.10, "lab_coat": 1.06}
_REFLECTIVE: Rgb = (222, 226, 228)
_DARK: Rgb = (30, 26, 26)


def darker(colour: Rgb, share: float) -> Rgb:
    """A colour times `share`."""
    return (min(round(colour[0] * share), 255), min(round(colour[1] * share), 255), min(round(colour[2] * share), 255))


def _top(look: Appearance) -> Rgb:
    return look.over if look.top in _SIDE_SHARE else look.shirt


def _sleeve(look: Appearance) -> Rgb:
    return look.shirt if look.top == "vest" else _top(look)


def _rings(k: float, wide: float, *rings: Ring) -> tuple[Ring, ...]:
    """Return rings scaled by the body's size `k` and width."""
    return tuple((z * k, rx * k * wide, ry * k * wide) for z, rx, ry in rings)


def _tube(mesh: MeshBuilder, frame: Frame, colour: Rgb, sides: int, *rings: Ring, x_m: float = 0.0) -> None:
    """Add a closed tube around the middle of the body, or `x_m` ahead of it; rings ordered upwards, m."""
    mesh.prism(frame, [((x_m, 0.0, z), rx, ry) for z, rx, ry in rings], colour, sides)


def trunk(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Add pelvis to neck with clothes and bags; origin between the hip joints, x to the front."""
    k = look.scale
    frame = frame.at((0.0, 0.0, -HIP_M * k))
    wide = look.build
    over = _SIDE_SHARE.get(look.top, 1.0)
    hips = _rings(k, wide, (0.80, 0.085, 0.13), (0.88, 0.11, 0.165), (0.99, 0.105, 0.155))
    _tube(mesh, frame, look.trousers, 10, *hips)
    torso = _rings(
        k, wide * over, (0.95, 0.11, 0.158), (1.06, 0.102, 0.148), (1.18, 0.115, 0.163), (1.30, 0.125, 0.182),
        (1.37, 0.114, 0.184), (1.42, 0.094, 0.150), (1.455, 0.066, 0.088),
        (1.48, 0.052, 0.060),
    )  # fmt: skip
    _tube(mesh, frame, _top(look), 10, *torso)
    _tube(mesh, frame, look.skin, 7, *_rings(k, 1.0, (1.44, 0.05, 0.052), (1.53, 0.048, 0.05)))
    front = 0.117 * k * wide * over
    if look.top == "vest":
        for z in (1.05, 1.20):
            band = _rings(k, wide * over * 1.04, (z - 0.025, 0.115, 0.165), (z + 0.025, 0.118, 0.168))
            _tube(mesh, frame, _REFLECTIVE, 10, *band)
        for side in (-0.1, 0.1):
            mesh.box(frame, (0.0, side * k, 1.33 * k), (0.262 * k * wide, 0.05 * k, 0.16 * k), _REFLECTIVE)
    elif look.top in ("jacket", "coat", "lab_coat"):
        mesh.box(frame, (front - 0.012, 0, 1.30 * k), (0.03, 0.085 * k, 0.22 * k), look.shirt)
        mesh.box(frame, (front - 0.016, 0, 1.06 * k), (0.03, 0.012 * k, 0.26 * k), darker(_top(look), 0.6))
    elif look.top == "scrubs":
        mesh.box(frame, (0.085 * k, 0, 1.425 * k), (0.05, 0.09 * k, 0.06 * k), look.skin)
        mesh.box(frame, (front - 0.014, 0.08 * k, 1.30 * k), (0.03, 0.07 * k, 0.07 * k), darker(look.shirt, 0.8))
    else:
        _tube(mesh, frame, _DARK, 10, *_rings(k, wide * 1.02, (0.945, 0.112, 0.162), (0.975, 0.112, 0.162)))
    if look.carries == "backpack":
        mesh.box(frame, (-0.19 * k * wide, 0, 1.24 * k), (0.17, 0.28 * k, 0.40 * k), look.bag)
        mesh.box(frame, (-0.27 * k * wide, 0, 1.16 * k), (0.05, 0.22 * k, 0.18 * k), darker(look.bag, 0.75))
        for side in (-0.11, 0.11):
            mesh.box(frame, (0.0, side * k, 1.34 * k), (0.258 * k * wide, 0.035, 0.17 * k), darker(look.bag, 0.75))
    elif look.carries == "bag":
        mesh.box(frame, (0.02, -0.215 * k * wide, 0.98 * k), (0.26, 0.09, 0.22 * k), look.bag)
        mesh.box(frame, (0.0, -0.19 * k * wide, 1.25 * k), (0.03, 0.03, 0.36 * k), darker(look.bag, 0.75))


def head(mesh: MeshBuilder, frame: Frame, look: Appearance, face: bool = True) -> None:
    """Add head, hair, cap or helmet, with or without a face; origin at the neck's base."""
    k = look.scale
    frame = frame.at((0.0, 0.0, -NECK_M * k))
    mesh.ball(frame, (0.012 * k, 0, 1.605 * k), (0.098 * k, 0.078 * k, 0.122 * k), look.skin, 10)
    if face:
        for side in (-1, 1):
            mesh.box(frame, (0.100 * k, side * 0.031 * k, 1.622 * k), (0.018, 0.026, 0.010), (226, 222, 216))
            mesh.box(frame, (0.103 * k, side * 0.031 * k, 1.622 * k), (0.018, 0.013, 0.013), _DARK)
            mesh.box(frame, (0.100 * k, side * 0.031 * k, 1.645 * k), (0.02, 0.032, 0.006), darker(look.hair, 0.8))
            mesh.box(frame, (0.005 * k, side * 0.079 * k, 1.605 * k), (0.035, 0.018, 0.055), darker(look.skin, 0.9))
        mesh.box(frame, (0.108 * k, 0, 1.592 * k), (0.032, 0.024, 0.034), darker(look.skin, 0.9))
        mesh.box(frame, (0.097 * k, 0, 1.552 * k), (0.016, 0.046, 0.012), (158, 78, 74))
    style = look.hair_style
    if style in ("short", "long", "bun", "cap"):
        mesh.ball(frame, (-0.016 * k, 0, 1.642 * k), (0.102 * k, 0.088 * k, 0.100 * k), look.hair, 10)
    if style == "long":
        fall = (((-0.05 * k, 0, 1.42 * k), 0.045 * k, 0.085 * k), ((-0.045 * k, 0, 1.52 * k), 0.065 * k, 0.098 * k),
                ((-0.035 * k, 0, 1.64 * k), 0.075 * k, 0.092 * k))  # fmt: skip
        mesh.prism(frame, fall, darker(look.hair, 0.92), 8)
    elif style == "bun":
        mesh.ball(frame, (-0.115 * k, 0, 1.675 * k), (0.05 * k, 0.05 * k, 0.05 * k), darker(look.hair, 0.92), 7)
    elif style == "bald":
        rings = _rings(k, 1.0, (1.55, 0.072, 0.084), (1.63, 0.078, 0.086))
        _tube(mesh, frame, look.hair, 8, *rings, x_m=-0.03 * k)
    elif style == "cap":
        mesh.ball(frame, (-0.004 * k, 0, 1.672 * k), (0.112 * k, 0.095 * k, 0.078 * k), look.head, 10)
        mesh.box(frame, (0.125 * k, 0, 1.665 * k), (0.10, 0.13 * k, 0.012), darker(look.head, 0.8))
    elif style == "helmet":
        dome = _rings(k, 1.0, (1.645, 0.135, 0.118), (1.70, 0.120, 0.104), (1.745, 0.08, 0.07), (1.762, 0.03, 0.026))
        _tube(mesh, frame, look.head, 10, *dome)
        mesh.box(frame, (0.14 * k, 0, 1.65 * k), (0.07, 0.16 * k, 0.014), darker(look.head, 0.9))


def thigh(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Hip to knee; origin at the hip joint."""
    k = look.scale
    bare = look.legs in ("shorts", "skirt", "dress")
    w = k * look.build * (0.78 if tail_m(look) else 1.0)  # hidden by cloth, so it may be thinner
    rings = ((-THIGH_M * k, 0.062 * w, 0.060 * w), (-0.20 * k, 0.078 * w, 0.075 * w), (0.02, 0.090 * w, 0.085 * w))
    _tube(mesh, frame, look.skin if bare else look.trousers, 8, *rings)
    if look.legs == "shorts":
        _tube(mesh, frame, look.trousers, 8, (-0.30 * k, 0.09 * w, 0.088 * w), (0.02, 0.098 * w, 0.09 * w))


def shin(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Knee to sole; origin at the knee joint."""
    k = look.scale
    w = k * look.build
    if look.legs == "trousers":
        rings = ((-SHIN_M * k, 0.058 * w, 0.054 * w), (-0.15 * k, 0.062 * w, 0.058 * w), (0.02, 0.063 * w, 0.061 * w))
        _tube(mesh, frame, darker(look.trousers, 0.94), 8, *rings)
    else:
        ankle = (-(SHIN_M + 0.03) * k, 0.036 * k, 0.034 * k)
        _tube(mesh, frame, look.skin, 8, ankle, (-0.14 * k, 0.055 * w, 0.052 * w), (0.02, 0.058 * w, 0.056 * w))
    bottom = -(SHIN_M + ANKLE_M) * k
    mesh.box(frame, (0.045 * k, 0, bottom + 0.035 * k), (0.255 * k, 0.088 * k, 0.07 * k), look.shoes)
    mesh.box(frame, (-0.015 * k, 0, bottom + 0.075 * k), (0.13 * k, 0.082 * k, 0.05 * k), look.shoes)
    sole = (236, 236, 232) if sum(look.shoes) < 400 else _DARK
    mesh.box(frame, (0.045 * k, 0, bottom + 0.008), (0.262 * k, 0.092 * k, 0.016), sole)


def upper_arm(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Shoulder to elbow; origin at the shoulder joint."""
    k = look.scale
    over = _SIDE_SHARE.get(look.top, 1.0) if look.top != "vest" else 1.0
    w = k * look.build * over
    sleeve = _sleeve(look)
    mesh.ball(frame, (0, 0, -0.012 * k), (0.056 * w, 0.050 * w, 0.052 * w), sleeve, 8)
    low = look.skin if _bare_arms(look) else sleeve
    _tube(mesh, frame, low, 7, (-UPPER_ARM_M * k, 0.042 * w, 0.040 * w), (-0.16 * k, 0.047 * w, 0.045 * w))
    _tube(mesh, frame, sleeve, 7, (-0.19 * k, 0.052 * w, 0.049 * w), (0.0, 0.057 * w, 0.053 * w))


def forearm(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Elbow to fingertips; origin at the elbow joint."""
    k = look.scale
    w = k * look.build
    colour = look.skin if _bare_arms(look) else darker(_sleeve(look), 0.95)
    _tube(mesh, frame, colour, 7, (-FOREARM_M * k, 0.032 * w, 0.030 * w), (0.015, 0.044 * w, 0.042 * w))
    hand = (
        ((0.01, 0, -(FOREARM_M + 0.16) * k), 0.022 * k, 0.014 * k),
        ((0.006, 0, -(FOREARM_M + 0.08) * k), 0.044 * k, 0.020 * k),
        ((0, 0, -FOREARM_M * k), 0.028 * k, 0.024 * k),
    )
    mesh.prism(frame, hand, look.skin, 6)


def _bare_arms(look: Appearance) -> bool:
    return look.top == "scrubs" or (look.top == "shirt" and sum(look.shirt) % 2 == 0)


def tail(mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
    """Add skirt, dress or coat tails around both legs; origin between the hip joints."""
    length = tail_m(look)
    hangs_from_legs = look.legs in ("skirt", "dress")
    colour, flare = (look.trousers, 1.06) if hangs_from_legs else (look.over, 1.0)
    k = look.scale
    w = k * look.build
    hem, thighs = (-length * k, 0.235 * w * flare, 0.195 * w * flare), (-0.24 * k, 0.180 * w * flare, 0.185 * w)
    _tube(mesh, frame, colour, 10, hem, thighs, (-0.08 * k, 0.138 * w, 0.182 * w), (0.09 * k, 0.116 * w, 0.166 * w))


def tail_m(look: Appearance) -> float:
    """Return how far a skirt, dress or coat reaches below the hips, m; 0 for other clothes."""
    lengths = {"skirt": 0.46, "dress": 0.50}
    return lengths.get(look.legs, {"coat": 0.48, "lab_coat": 0.38}.get(look.top, 0.0))
