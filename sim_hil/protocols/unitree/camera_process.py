"""The camera process of a Unitree robot (`videohub.py`), as its parent starts it."""

from __future__ import annotations

import sys

from firmware_bridge.core.config import DdsConfig
from sim_hil.protocols.render_process import RenderProcess


class CameraProcess(RenderProcess):
    """Serves pictures over DDS; takes fault commands through `send` if it was started with `faults`."""

    def __init__(
        self,
        scene: str,
        *,
        people: int,
        seed: int,
        size: tuple[int, int],
        dds: DdsConfig,
        state_length: int,
        faults: bool = False,
    ) -> None:
        """`size`: (width, height) in pixels; `state_length`: numbers in a render state."""
        command = [sys.executable, "-m", "sim_hil.protocols.unitree.videohub", "--scene", scene]
        command += ["--people", str(people), "--seed", str(seed), "--width", str(size[0]), "--height", str(size[1])]
        command += ["--domain", str(dds.domain), "--interface", dds.interface]
        for peer in dds.peers:
            command += ["--peer", peer]
        if faults:
            command += ["--faults"]
        super().__init__(command, state_length)
