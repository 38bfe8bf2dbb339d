"""Stand-in for edge-run where only bridge, link and robot react: it drives the circle without camera and model.

    python -m tools.faults.rig.driver --robot FILE.toml

It arms, sends ten commands a second from the robot's newest pose, and ends with exit code 1 when the bridge has stopped
the robot or is gone. It starts in a fraction of edge-run's time, so that an injection takes about two seconds.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Final

from edge.core.geometry import SE2
from edge.robot.reader import RobotReader
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.state_client import StateReader
from tools.faults.rig.circle import steering

_PERIOD_NS: Final = 100_000_000
_ARM_AGAIN_TICKS: Final = 10
_POSE_AGE_NS: Final = 500_000_000
"""Age beyond which a pose is not used: shorter than the time to leave the circle, longer than any fault is awaited."""


def _reader(config: RobotConfig) -> RobotReader:
    if config.protocol != "unitree":
        return StateReader(config)
    from firmware_bridge.unitree.client import Go2Reader  # needs the extra of its protocol

    return Go2Reader(config)


def _velocity(reader: RobotReader, now_ns: int) -> tuple[float, float]:
    """Return speed (m/s) and yaw rate (rad/s) on the circle; zero without a pose that is new enough."""
    state = reader.state()
    if state is None or now_ns - state.received_ns > _POSE_AGE_NS:
        return 0.0, 0.0
    return steering(SE2(*state.T_odom_base))


def drive(config: RobotConfig) -> str:
    """Drive until the bridge stops the robot; returns the reason. Raises BridgeUnavailable."""
    reader = _reader(config)
    client = BridgeClient(Path(config.bridge.socket))
    begun_ns, ticks, armed, asked = time.monotonic_ns(), 0, False, False
    while True:
        status = client.poll()
        state = "disarmed" if status is None else status.state
        if armed and status is not None and state != "armed":
            return status.reason
        armed = armed or state == "armed"
        if status is not None and status.permit == "needed" and not asked:
            asked = True
            sys.stderr.write("driver: waiting for `edge-bridge arm`\n")
            sys.stderr.flush()
        if state not in ("arming", "armed") and ticks % _ARM_AGAIN_TICKS == 0:
            client.arm()
        speed_mps, turn_radps = _velocity(reader, time.monotonic_ns()) if armed else (0.0, 0.0)
        ticks += 1
        client.send_velocity(ticks, time.monotonic_ns(), speed_mps, 0.0, turn_radps)
        time.sleep(max(0.0, (begun_ns + ticks * _PERIOD_NS - time.monotonic_ns()) / 1e9))


def main(argv: list[str] | None = None) -> int:
    """Drive, then tell why the run has ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, required=True, metavar="FILE.toml")
    args = parser.parse_args(argv)
    try:
        reason = drive(load_robot_config(args.robot))
    except BridgeUnavailable as error:
        reason = str(error)
    sys.stderr.write(f"driver: {reason}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
