"""Scenes by name: shipped scenes, scene files, and the benchmark's layouts, such as `office-60`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from sim_hil.layouts import KINDS, LayoutError, generate, is_reserved
from sim_hil.scene.scene import Scene, SceneError, load_scene

_LAYOUT = re.compile(rf"({'|'.join(KINDS)})-(0|[1-9]\d{{0,3}})", re.ASCII)


def layout_name(kind: str, seed: int) -> str:
    """Return the name by which `open_scene` finds a layout; it begins with the kind, which decides people's clothes."""
    return f"{kind}-{seed}"


def open_scene(name_or_path: str | Path) -> Scene:
    """Return a shipped scene, the scene of a TOML file, or the layout of a reserved seed. Raises SceneError."""
    match = _LAYOUT.fullmatch(str(name_or_path))
    if match is None or not is_reserved(int(match[2])):
        return load_scene(name_or_path)
    try:
        scene = generate(match[1], int(match[2]), reserved=True)
    except LayoutError as error:
        raise SceneError(str(error)) from error
    return replace(scene, name=match[0])
