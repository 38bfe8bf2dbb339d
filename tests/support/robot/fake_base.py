"""Fake drive of a wheeled base: notes what its protocol requests."""

from __future__ import annotations


class FakeBase:
    """Drive whose velocity is the last command while it is powered."""

    def __init__(self) -> None:
        self.velocity = (0.0, 0.0, 0.0)
        self.powered = self.stopped = False

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        self.velocity = (vx_mps, vy_mps, wz_radps)

    def stand(self) -> None:
        self.powered = True

    def rest(self) -> None:
        self.powered, self.velocity = False, (0.0, 0.0, 0.0)

    def press_estop(self) -> None:
        self.stopped = True
        self.rest()

    def release_estop(self) -> None:
        self.stopped = False
