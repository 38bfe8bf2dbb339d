"""Appearance of each person: build, clothes, skin and hair, drawn from a seed; some wear work clothes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Appearance:
    """Appearance of a person: colours as RGB 0..255, body scale (1: 1.72 m tall) and build (1: average width).

    top: shirt, jacket, coat, scrubs, lab_coat or vest (hi-vis); legs: trousers, skirt, shorts or dress;
    hair_style: short, long, bun, bald, cap or helmet; carries: "", backpack or bag.
    """

    shirt: Rgb
    trousers: Rgb
    skin: Rgb
    hair: Rgb
    shoes: Rgb
    scale: float
    build: float
    top: str
    over: Rgb  # colour of a jacket, coat or vest
    legs: str
    hair_style: str
    head: Rgb  # colour of a cap or helmet
    carries: str
    bag: Rgb


_SHIRTS: Final[tuple[Rgb, ...]] = (
    (188, 42, 40), (36, 88, 160), (232, 196, 70), (60, 130, 80), (235, 235, 230), (110, 60, 140), (225, 120, 40),
    (120, 170, 210), (40, 44, 52), (205, 150, 160), (150, 155, 160), (30, 110, 115), (245, 220, 190),
)  # fmt: skip
_JACKETS: Final[tuple[Rgb, ...]] = (
    (38, 40, 48), (70, 74, 82), (96, 72, 50), (34, 52, 92), (112, 30, 36), (74, 84, 56), (160, 140, 112),
    (180, 180, 176),
)  # fmt: skip
_TROUSERS: Final[tuple[Rgb, ...]] = (
    (38, 44, 62), (70, 68, 64), (112, 92, 66), (28, 28, 30), (58, 82, 118), (84, 88, 96), (150, 134, 104),
)  # fmt: skip
_SKIRTS: Final[tuple[Rgb, ...]] = ((40, 40, 46), (120, 40, 60), (60, 84, 120), (150, 120, 80), (90, 110, 70))
_SKINS: Final[tuple[Rgb, ...]] = (
    (244, 208, 182), (241, 200, 170), (226, 176, 138), (214, 160, 120), (186, 130, 92), (160, 108, 74), (130, 84, 56),
    (104, 68, 46), (82, 54, 38),
)  # fmt: skip
_HAIRS: Final[tuple[Rgb, ...]] = (
    (30, 24, 20), (48, 34, 24), (86, 56, 30), (120, 78, 40), (176, 136, 80), (150, 60, 34), (120, 120, 122),
    (196, 194, 190),
)  # fmt: skip
_SHOES: Final[tuple[Rgb, ...]] = ((24, 22, 22), (60, 44, 32), (225, 225, 225), (90, 90, 96), (150, 40, 40))
_BAGS: Final[tuple[Rgb, ...]] = ((40, 60, 90), (30, 30, 34), (140, 50, 40), (90, 100, 60), (200, 160, 60))
_SCRUBS: Final[tuple[Rgb, ...]] = ((60, 130, 140), (70, 120, 180), (90, 150, 120))
_VESTS: Final[tuple[Rgb, ...]] = ((240, 120, 20), (200, 230, 40))
_HELMETS: Final[tuple[Rgb, ...]] = ((250, 205, 40), (245, 245, 240), (40, 90, 190), (230, 90, 30))

# Shares of people in work clothes, by the prefix of the scene's name; the others wear everyday clothes.
_AT_WORK: Final = {"hospital": (("scrubs", 0.28), ("lab_coat", 0.22)), "warehouse": (("vest", 0.75),)}


def appearances(count: int, seed: int, scene_name: str = "") -> list[Appearance]:
    """Return the appearances of the first `count` people of a seed; equal in physics and camera process."""
    work = next((clothes for kind, clothes in _AT_WORK.items() if scene_name.startswith(kind)), ())
    outdoors = scene_name.startswith("sidewalk")
    return [_draw(np.random.default_rng((seed, 11, index)), work, outdoors) for index in range(count)]


def _one(rng: np.random.Generator, pool: tuple[Rgb, ...]) -> Rgb:
    return pool[int(rng.integers(len(pool)))]


def _draw(rng: np.random.Generator, work: tuple[tuple[str, float], ...], outdoors: bool) -> Appearance:
    top = _top(rng, work, outdoors)
    woman = bool(rng.uniform() < 0.5)
    # Heights of adults: 1.66 +- 0.07 m and 1.78 +- 0.07 m, clipped so that everybody fits through doorways.
    height = float(np.clip(rng.normal(1.66 if woman else 1.78, 0.07), 1.5, 1.97))
    legs = "trousers"
    draw = float(rng.uniform())
    if top not in ("vest", "scrubs"):
        legs = ("skirt" if draw < 0.22 else "dress" if draw < 0.36 else legs) if woman else legs
        legs = "shorts" if legs == "trousers" and outdoors and draw > 0.85 else legs
    hair_style = _hair(rng, woman, helmet=top == "vest")
    shirt, trousers = _one(rng, _SHIRTS), _one(rng, _SKIRTS if legs == "skirt" else _TROUSERS)
    if top == "scrubs":
        shirt = trousers = _one(rng, _SCRUBS)
    over = {"lab_coat": (240, 242, 244), "vest": _one(rng, _VESTS)}.get(top, _one(rng, _JACKETS))
    carries = "" if work else ("backpack", "bag", "", "", "")[int(rng.integers(5))]
    return Appearance(
        shirt=shirt, trousers=shirt if legs == "dress" else trousers, skin=_one(rng, _SKINS), hair=_one(rng, _HAIRS),
        shoes=_one(rng, _SHOES), scale=height / 1.72, build=float(np.clip(rng.normal(1.0, 0.09), 0.84, 1.28)), top=top,
        over=over, legs=legs, hair_style=hair_style, head=_one(rng, _HELMETS), carries=carries, bag=_one(rng, _BAGS),
    )  # fmt: skip


def _top(rng: np.random.Generator, work: tuple[tuple[str, float], ...], outdoors: bool) -> str:
    draw = float(rng.uniform())
    for what, share in work:
        if draw < share:
            return what
        draw -= share
    draw = float(rng.uniform())
    coats, jackets = (0.22, 0.52) if outdoors else (0.06, 0.34)
    return "coat" if draw < coats else "jacket" if draw < jackets else "shirt"


def _hair(rng: np.random.Generator, woman: bool, helmet: bool) -> str:
    draw = float(rng.uniform())
    if helmet and draw < 0.85:
        return "helmet"
    draw = float(rng.uniform())
    if woman:
        return "long" if draw < 0.5 else "bun" if draw < 0.75 else "short"
    return "bald" if draw < 0.14 else "cap" if draw < 0.26 else "short"
