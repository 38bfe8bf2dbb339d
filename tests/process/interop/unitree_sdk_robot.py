"""A robot on the maker's own Python SDK, unmodified: its RPC server, lease server and publishers; a point is its body.

usage: unitree_sdk_robot.py DOMAIN INTERFACE TRACE. Run by test_interop_unitree_sdk_robot.py; imports nothing of ours.
Every request becomes a JSON line in TRACE. A line on stdin is a command: "silent" and "report" stop and start the
reports; the end of stdin ends the robot.
"""

import json
import sys
import threading
import time

from unitree_sdk2py.core.channel import ChannelFactoryInitialize, ChannelPublisher
from unitree_sdk2py.go2.sport import sport_api as api
from unitree_sdk2py.idl.default import (
    unitree_go_msg_dds__LowState_,
    unitree_go_msg_dds__SportModeState_,
    unitree_go_msg_dds__WirelessController_,
)
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowState_, SportModeState_, WirelessController_
from unitree_sdk2py.rpc.server import Server

BALANCE_STAND, LOCOMOTION, LIE_DOWN, JOINT_LOCK = 1, 3, 5, 6
MODE_AFTER = {
    api.SPORT_API_ID_STANDUP: JOINT_LOCK,
    api.SPORT_API_ID_BALANCESTAND: BALANCE_STAND,
    api.SPORT_API_ID_RECOVERYSTAND: BALANCE_STAND,
}
PERIOD_S = 0.02
HOLD_S = 1.0  # as long as a Go2 keeps to a Move
LEASE_S = 1.0


class SportService(Server):
    """The sport service's requests that the bridge may send; the SDK answers every other one with 3203."""

    def __init__(self, trace):
        super().__init__(api.SPORT_SERVICE_NAME)
        self.trace = trace
        self.mode, self.target, self.moved_s = LIE_DOWN, (0.0, 0.0, 0.0), 0.0

    def Init(self):  # noqa: N802 (the SDK's name)
        self._SetApiVersion(api.SPORT_API_VERSION)
        self._RegistHandler(api.SPORT_API_ID_MOVE, self.move, True)
        self._RegistHandler(api.SPORT_API_ID_STOPMOVE, self.stop, True)
        for api_id, mode in MODE_AFTER.items():
            self._RegistHandler(api_id, lambda _, api_id=api_id, mode=mode: self.stand(api_id, mode), True)

    def move(self, parameter):
        velocity = json.loads(parameter)
        self.target, self.moved_s = (velocity["x"], velocity["y"], velocity["z"]), time.monotonic()
        if any(self.target):
            self.mode = LOCOMOTION
        self.note(api.SPORT_API_ID_MOVE, self.target)
        return 0, ""

    def stop(self, _parameter):
        self.target = (0.0, 0.0, 0.0)
        self.mode = BALANCE_STAND if self.mode == LOCOMOTION else self.mode
        self.note(api.SPORT_API_ID_STOPMOVE)
        return 0, ""

    def stand(self, api_id, mode):
        self.mode = mode
        self.note(api_id)
        return 0, ""

    def note(self, api_id, velocity=None):
        line = {"t_ns": time.monotonic_ns(), "api_id": api_id, "velocity": velocity}
        self.trace.write(json.dumps(line) + "\n")
        self.trace.flush()


class Robot:
    """Reports at 50 Hz; its body has no mass: it has the commanded velocity at once, along its first heading."""

    def __init__(self, service):
        self.service, self.reporting, self.x_m = service, True, 0.0
        self.state = ChannelPublisher("rt/sportmodestate", SportModeState_)
        self.low_state = ChannelPublisher("rt/lf/lowstate", LowState_)
        self.remote = ChannelPublisher("rt/wirelesscontroller", WirelessController_)
        for publisher in (self.state, self.low_state, self.remote):
            publisher.Init()
        self.message, self.low_message = unitree_go_msg_dds__SportModeState_(), unitree_go_msg_dds__LowState_()
        self.message.imu_state.quaternion = [1.0, 0.0, 0.0, 0.0]
        self.low_message.bms_state.soc, self.low_message.power_v = 100, 29.0

    def run(self):
        step = 0
        while True:
            time.sleep(PERIOD_S)
            step += 1
            held = time.monotonic() - self.service.moved_s < HOLD_S
            vx_mps = self.service.target[0] if held else 0.0
            self.x_m += vx_mps * PERIOD_S
            if self.reporting:
                self.report(vx_mps)
                if step % 10 == 0:
                    self.low_state.Write(self.low_message)

    def report(self, vx_mps):
        message, now_ns = self.message, time.monotonic_ns()
        message.stamp.sec, message.stamp.nanosec = divmod(now_ns, 1_000_000_000)
        message.mode, message.position = self.service.mode, [self.x_m, 0.0, 0.0]
        message.velocity = [vx_mps, 0.0, 0.0]
        self.state.Write(message)
        self.remote.Write(unitree_go_msg_dds__WirelessController_())


def main():
    ChannelFactoryInitialize(int(sys.argv[1]), sys.argv[2])
    with open(sys.argv[3], "w", encoding="utf-8") as trace:  # noqa: PTH123 (imports nothing it can do without)
        service = SportService(trace)
        service.Init()
        service.StartLease(LEASE_S)
        service.Start(False)
        robot = Robot(service)
        threading.Thread(target=robot.run, daemon=True).start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        for line in sys.stdin:
            robot.reporting = line.strip() != "silent"


if __name__ == "__main__":
    main()
