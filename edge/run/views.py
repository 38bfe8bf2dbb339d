"""Feeds a run's live view and its ROS 2 node without waiting."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from edge.flightlog.recorder import Recorder
from edge.live.feed import LiveFeed, Ros2Feed
from edge.live.options import LiveError, LiveOptions
from edge.robot.arming import RefusedError
from firmware_bridge.core.config import RobotConfig

LIVE_STOP: Final = "The live view's STOP button has ended the run. Start a new run when the way is free."


class Views:
    """The views of one run; `live` and `ros2` are None where nobody has asked for them."""

    def __init__(self) -> None:
        self.live: LiveFeed | None = None
        self.ros2: Ros2Feed | None = None

    def open(
        self, live: LiveOptions | None, robot: RobotConfig, stop: Callable[[], bool], say: Callable[[str], None]
    ) -> None:
        """Start what the options and the robot file ask for, and print where it is. Raises RefusedError.

        `stop` stops the robot and returns whether its bridge has confirmed it.
        """
        try:
            if live is not None:
                self.live = LiveFeed(live, robot.bridge.socket, stop, say)
                say(f"live view: {self.live.url}")
            if robot.ros2_publish.publish:
                self.ros2 = Ros2Feed(robot, say)
                say(self.ros2.ready)
        except LiveError as error:
            raise RefusedError(str(error)) from error

    def watch(self, recorder: Recorder | None) -> None:
        """Let the live view tell whether the flight log is whole."""
        if self.live is not None:
            self.live.recorder = recorder

    def close(self) -> None:
        """End them; may be called twice."""
        for view in (self.live, self.ros2):
            if view is not None:
                view.close()
