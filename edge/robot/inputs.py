"""Robot inputs of the runner: reports through the drift estimator into the pose history, and the camera.

Reports are taken in the thread that reads them, pictures in the camera's; the control thread only reads the
results.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from edge.flightlog.recorder import RecordSink
from edge.flightlog.records import Throttle, battery_record, odometry_record
from edge.odometry.calibration import OdometryCalibration, load_calibration
from edge.odometry.camera_geometry import Attitude, CameraGeometry
from edge.odometry.estimator import DriftEstimator, OdometryOutputs
from edge.odometry.gate import OdometryInputs
from edge.odometry.visual_odometry import VisualOdometry, grey_frame
from edge.robot.camera import CameraPoller
from edge.robot.reader import open_reader
from edge.safety.faults.findings import FindingQueue
from edge.safety.late_command import HOLD_NS, REPEAT_NS
from edge.safety.monitors.robot import LinkMonitor
from edge.state.frame import Frame
from edge.state.pose_history import PoseHistory
from firmware_bridge.client import BridgeClient, BridgeStatus
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import BatteryState, RobotState
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.state_client import StateReader

ODOMETRY_LOG_HZ = 50.0
BATTERY_LOG_HZ = 1.0


class CommandTap:
    """Keeps the velocity in force on its way to the bridge; any thread may read `commanded` and call `hold`."""

    SPACING: ClassVar = HOLD_NS // REPEAT_NS + 2
    """The bridge's numbers per command, so that zeros fit between two commands without a lock."""

    def __init__(self, bridge: BridgeClient) -> None:
        self._bridge = bridge
        self.commanded: tuple[float, float, float] | None = None
        """(vx m/s, vy m/s, ωz rad/s) sent last; None before the first."""
        self._sent = (0, 0)  # number of the last command for the bridge, stamp in ns
        self._last_hold = 0

    @property
    def sent_ns(self) -> int | None:
        """Stamp of the control thread's last command, ns; None before the first."""
        return self._sent[1] or None

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """See `BridgeClient`; the control thread alone may call it."""
        self.commanded = (vx_mps, vy_mps, wz_radps)
        number = seq * self.SPACING
        sent = self._bridge.send_velocity(number, stamp_ns, vx_mps, vy_mps, wz_radps)
        self._sent = (number, stamp_ns)
        return sent

    def hold(self, stamp_ns: int) -> bool:
        """Send zero after the last command and before the next one; a second thread may call it."""
        number = max(self._sent[0], self._last_hold) + 1
        if number >= self._sent[0] + self.SPACING:
            return False
        self._last_hold = number
        self.commanded = (0.0, 0.0, 0.0)
        return self._bridge.send_velocity(number, stamp_ns, 0.0, 0.0, 0.0)

    def poll(self) -> BridgeStatus | None:
        """See `BridgeClient`."""
        return self._bridge.poll()


class RobotInputs:
    """One robot's reports and pictures. Raises LinkOpenError when its link cannot be opened, CalibrationError."""

    def __init__(
        self,
        robot: RobotConfig,
        *,
        image_px: int,
        period_ns: int,
        commanded: Callable[[], tuple[float, float, float] | None],
        say: Callable[[str], None],
        on_death: Callable[[str], None] = lambda why: None,
        bus: SharedBus | None = None,
    ) -> None:
        """`commanded`: the velocity in force now; it must not wait. `bus`: as of `open_reader`.

        `on_death` takes why the thread of the reports or of the pictures has ended, in that thread.
        """
        file = robot.odometry.calibration
        self.estimator = DriftEstimator(_calibration(file))
        self.history = PoseHistory()
        self.findings = FindingQueue()
        self.states = 0
        """Reports so far."""
        self.recorder: RecordSink | None = None
        """Where reports are logged, once there is a log."""
        self._commanded = commanded
        self._say = say
        self._log_odometry, self._log_battery = Throttle(ODOMETRY_LOG_HZ), Throttle(BATTERY_LOG_HZ)
        self._newest: OdometryOutputs | None = None
        self._link = LinkMonitor()
        self._has_driven = False
        mount = robot.mount
        self._eye: VisualOdometry | None = None
        if mount is not None:
            hfov_rad, pitch_rad = math.radians(mount.hfov_deg), math.radians(mount.pitch_deg)
            self._eye = VisualOdometry(CameraGeometry(hfov_rad, mount.height_m, pitch_rad, mount.forward_m))
        self.reader, self._source = open_reader(robot, on_death, bus)
        self.reader.set_state_listener(self._on_state)
        self.camera = CameraPoller(
            self._source.request_frame,
            image_px=image_px,
            period_ns=max(period_ns, round(1e9 / robot.camera.rate_hz)),
            timeout_s=robot.camera.timeout_ms / 1e3,
            latency_ns=round(robot.camera.latency_ms * 1e6),
            captured_ns=lambda: self._source.captured_ns,
            on_frame=self._see,
            on_death=on_death,
        )

    @property
    def ready(self) -> bool:
        """Whether there has been a picture and a pose."""
        return self.camera.newest is not None and self.history.newest() is not None

    def why_missing(self, status: BridgeStatus | None) -> str:
        """Return in brackets why a pose or a picture is missing, as far as it is known; `status`: the bridge's.

        Except with a Go2, only the bridge reads the robot's link and knows what is wrong with it.
        """
        why = self.camera.last_error
        if self.history.newest() is None and isinstance(self.reader, StateReader):
            why = self.reader.link_error or ("" if status is None else status.reason)
        return f" ({why})" if why else ""

    @property
    def odometry(self) -> OdometryOutputs | None:
        """Last outputs of the drift estimator."""
        return self._newest

    def offset_covariance(self, anchor_ns: int) -> npt.NDArray[np.float64] | None:
        """3×3 covariance (m², rad²) of the motion since an instant; None while it is not known."""
        found = self.estimator.motion_offset(anchor_ns)
        return None if found is None else found[1]

    def battery(self) -> BatteryState | None:
        """The battery's newest report."""
        return self.reader.battery()

    def close(self) -> None:
        """Stop asking and listening."""
        self.camera.close()
        self._source.close()
        self.reader.close()

    def _on_state(self, state: RobotState) -> None:
        self.states += 1
        now_ns = time.monotonic_ns()
        commanded = self._commanded()
        if not self._has_driven and commanded is not None and any(commanded):
            # Some robots change the rate of their reports when the bridge arms them: that is no loss.
            self._has_driven, self._link = True, LinkMonitor()
        outputs = self._newest = self.estimator.step(
            OdometryInputs(
                received_ns=state.received_ns,
                T_odom_base=state.T_odom_base,
                vx_mps=state.vx_mps,
                vy_mps=state.vy_mps,
                wz_radps=state.wz_radps,
                gyro_wz_radps=state.gyro_wz_radps,
                roll_rad=state.roll_rad,
                pitch_rad=state.pitch_rad,
                robot_stamp_ns=state.robot_stamp_ns,
                foot_forces=state.foot_forces if any(state.foot_forces) else None,
                commanded=commanded,
            ),
            now_ns,
        )
        if outputs.pose is not None:
            self.history.put(outputs.pose)
        findings = (*outputs.findings, *self._link.step(state.robot_stamp_ns))
        if findings:
            self.findings.put(findings)
        if self.recorder is not None:
            self._log(self.recorder, state, outputs, commanded, now_ns)

    def _log(
        self,
        recorder: RecordSink,
        state: RobotState,
        outputs: OdometryOutputs,
        commanded: tuple[float, float, float] | None,
        now_ns: int,
    ) -> None:
        if self._log_odometry.due(now_ns):
            fused = None if outputs.pose is None else outputs.pose.T_odom_base
            covariance = self.offset_covariance(now_ns - 5_000_000_000)
            record = odometry_record(state, fused, covariance, outputs.drift, commanded)
            recorder.put("/odometry", state.received_ns, record)
        battery = self.reader.battery()
        if battery is not None and self._log_battery.due(now_ns):
            recorder.put("/battery", battery.received_ns, battery_record(battery))

    def _see(self, frame: Frame) -> None:
        """The camera's motion from this picture; in the camera thread."""
        eye, attitude = self._eye, self.history.attitude_at(frame.stamp_ns)
        if eye is None or attitude is None:
            return
        try:
            grey = grey_frame(frame.jpeg)
            if grey is not None:
                motion = eye.step(grey, frame.stamp_ns, Attitude(*attitude))
                if motion is not None:
                    self.estimator.add_visual(motion)
        except (cv2.error, ValueError, np.linalg.LinAlgError) as error:
            # Odometry goes on without it; the camera thread must not end.
            self._eye = None
            self._say(f"visual odometry has ended ({str(error).splitlines()[0]}); the robot's own odometry is used")


def _calibration(file: Path | None) -> OdometryCalibration | None:
    return None if file is None else load_calibration(file)
