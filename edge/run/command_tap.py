"""Keeps the velocity in force, for monitors that compare it with the robot's motion."""

from __future__ import annotations

from firmware_bridge.client import BridgeClient, BridgeStatus


class CommandTap:
    """A `CommandSink` in front of the bridge; `commanded` may be read by any thread."""

    def __init__(self, bridge: BridgeClient) -> None:
        self._bridge = bridge
        self.commanded: tuple[float, float, float] | None = None
        """(vx m/s, vy m/s, ωz rad/s) sent last; None before the first."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """See `BridgeClient`."""
        self.commanded = (vx_mps, vy_mps, wz_radps)
        return self._bridge.send_velocity(seq, stamp_ns, vx_mps, vy_mps, wz_radps)

    def poll(self) -> BridgeStatus | None:
        """See `BridgeClient`."""
        return self._bridge.poll()
