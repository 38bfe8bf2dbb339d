"""Camera that is a ROS 2 topic. A thread keeps the newest message; it is decoded or encoded when it is requested."""

from __future__ import annotations

import threading
import time
from typing import Final

from edge.core.stamp_lag import StampLag
from edge.robot.cameras.newest import Backoff, NewestPicture, ReceivingThread
from edge.robot.cameras.ros2_pictures import compressed_picture, raw_picture
from firmware_bridge.core.config_ros2 import check_topic_name, dds_topic
from firmware_bridge.core.robot_state import CameraError, DdsError
from firmware_bridge.core.sections import DdsConfig
from firmware_bridge.dds.binding import has_writer
from firmware_bridge.dds.bus import DDS_ERRORS, take_bytes
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.ros2.messages.sensors import CompressedImage_, Image_

_WAIT_NS: Final = 100_000_000  # how soon close() is noticed


class Ros2Camera:
    """One topic of CompressedImage or Image; a `CameraSource`. Raises ConfigError for an illegal topic."""

    def __init__(
        self,
        network: DdsConfig | SharedBus,
        topic: str,
        raw: bool,
        *,
        reliable: bool = False,
        latency_ns: int = 0,
    ) -> None:
        """`network`: a process that reads more than one topic shares a SharedBus and closes it itself.

        `raw`: the topic carries sensor_msgs/Image. `reliable`: ask for lost pictures again, which matches reliable
        publishers only. `latency_ns`: age of the quickest picture when it arrives; those that take longer are older by
        their headers' stamps.
        """
        check_topic_name("camera.source", topic)
        self._topic, self._raw, self._reliable = dds_topic(topic), raw, reliable
        self._latency_ns = latency_ns
        self._lag = StampLag()
        self._owns_bus = isinstance(network, DdsConfig)
        self._bus = SharedBus(network) if isinstance(network, DdsConfig) else network
        self._newest: NewestPicture[bytes] = NewestPicture(f"{'ros2raw' if raw else 'ros2'}:{topic}")
        self.captured_ns: int | None = None
        self.header_stamp_ns: int | None = None
        """Stamp in the header of the picture returned last, on the camera's own clock; None: it has none."""
        self._thread = ReceivingThread(self._receive, self._newest.fail)

    def request_frame(self, timeout_s: float) -> bytes:
        """See `CameraSource`."""
        data, captured_ns = self._newest.take(timeout_s)
        before_ns = self.header_stamp_ns
        try:
            jpeg, self.header_stamp_ns = raw_picture(data) if self._raw else compressed_picture(data)
        except CameraError as error:
            raise CameraError(f"camera {self._newest.name}: {error}") from error
        # Some drivers never change the stamp: it tells nothing then.
        stamp_ns = None if self.header_stamp_ns == before_ns else self.header_stamp_ns
        self.captured_ns = captured_ns - self._lag.of(captured_ns, stamp_ns or 0)
        return jpeg

    def close(self) -> None:
        """See `CameraSource`."""
        self._thread.close()
        if self._owns_bus:
            self._bus.close()

    def _receive(self, closing: threading.Event, backoff: Backoff) -> None:
        """Receive pictures until `closing` is set. Raises CameraError when the network cannot be used."""
        kind = Image_ if self._raw else CompressedImage_
        try:
            bus = self._bus.open()
            reader = bus.reader(self._topic, kind, reliable=self._reliable)
            waitset = bus.waitset(reader)
            while not closing.is_set():
                waitset.wait(_WAIT_NS)
                for data, _ in take_bytes(reader):
                    self._newest.put(data, time.monotonic_ns() - self._latency_ns)
                    backoff.reset()
                if not has_writer(reader):
                    self._newest.fail(f"no node publishes {self._topic} as {kind.__name__.removesuffix('_')}")
        except DdsError as error:
            raise CameraError(str(error)) from error
        except DDS_ERRORS as error:
            raise CameraError(f"DDS: {error.msg}") from error
