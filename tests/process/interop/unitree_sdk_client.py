"""Uses all services of a Go2 with the maker's own Python SDK, unmodified; run by test_interop_unitree_sdk.py.

usage: unitree_sdk_client.py DOMAIN INTERFACE. The last line on stdout is JSON. Imports nothing of ours.
"""

import json
import math
import subprocess
import sys
import time

import cv2
import numpy as np
from unitree_sdk2py.comm.motion_switcher.motion_switcher_client import MotionSwitcherClient
from unitree_sdk2py.core.channel import ChannelFactoryInitialize, ChannelPublisher, ChannelSubscriber
from unitree_sdk2py.go2.obstacles_avoid.obstacles_avoid_client import ObstaclesAvoidClient
from unitree_sdk2py.go2.robot_state.robot_state_client import RobotStateClient
from unitree_sdk2py.go2.sport.sport_client import SportClient
from unitree_sdk2py.go2.video.video_client import VideoClient
from unitree_sdk2py.idl.default import unitree_go_msg_dds__LowCmd_
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_, SportModeState_
from unitree_sdk2py.utils.crc import CRC

STAND = (0.0, 0.8, -1.55) * 4  # hip, thigh, calf
JOINTS = 12


def hold_lease(domain, interface):
    """Another process: hold the sport service's lease until our standard input ends."""
    ChannelFactoryInitialize(domain, interface)
    sport = SportClient(enableLease=True)
    sport.SetTimeout(3.0)
    sport.Init()
    sport.WaitLeaseApplied()
    codes = [sport.StopMove() for _ in range(3)]
    sys.stdout.write(f"codes {json.dumps(codes)}\n")
    sys.stdout.flush()
    sys.stdin.read()


def percentile(values, share):
    return round(sorted(values)[min(int(share * len(values)), len(values) - 1)], 3)


class Session:
    def __init__(self, domain, interface):
        self.domain, self.interface = domain, interface
        ChannelFactoryInitialize(domain, interface)
        self.states, self.lows = [], []
        state_channel = ChannelSubscriber("rt/sportmodestate", SportModeState_)
        state_channel.Init(self.states.append, 10)
        low_channel = ChannelSubscriber("rt/lowstate", LowState_)
        low_channel.Init(self.lows.append, 10)
        self.channels = (state_channel, low_channel)
        self.low_commands = ChannelPublisher("rt/lowcmd", LowCmd_)
        self.low_commands.Init()
        self.sport, self.video, self.robot = SportClient(), VideoClient(), RobotStateClient()
        self.avoid, self.switcher = ObstaclesAvoidClient(), MotionSwitcherClient()
        for client in (self.sport, self.video, self.robot, self.avoid, self.switcher):
            client.SetTimeout(3.0)
            client.Init()
        deadline = time.monotonic() + 15
        while not (self.states and self.lows) and time.monotonic() < deadline:
            time.sleep(0.05)
        # The SDK waits for the server to find its request writer, not for its response reader: ask until it answers.
        for client in (self.sport, self.robot, self.avoid, self.switcher):
            while client.GetServerApiVersion()[0] != 0 and time.monotonic() < deadline:
                time.sleep(0.1)
        self.result = {}

    def until_mode(self, mode, seconds=8.0):
        deadline = time.monotonic() + seconds
        while self.states[-1].mode != mode and time.monotonic() < deadline:
            time.sleep(0.02)
        return self.states[-1].mode

    def run(self):
        for part in (
            self.postures,
            self.walking,
            self.settings,
            self.avoidance,
            self.leases,
            self.rates,
            self.low_level,
        ):
            part()
        return self.result

    def postures(self):
        result = self.result
        result["mode_at_start"] = self.states[-1].mode
        result["stand"] = [self.sport.StandUp(), self.until_mode(6), self.sport.BalanceStand(), self.until_mode(1)]
        result["body_height_m"] = round(self.states[-1].body_height, 3)
        result["hello"] = [self.sport.Hello(), self.until_mode(2), self.states[-1].progress, self.until_mode(1)]
        result["sit"] = [self.sport.Sit(), self.until_mode(10), self.sport.RiseSit(), self.until_mode(1)]
        code = self.sport.Euler(0.3, 0.0, 0.0)
        time.sleep(1.5)
        result["euler"] = [code, round(self.states[-1].imu_state.rpy[0], 2)]
        self.sport.Euler(0.0, 0.0, 0.0)
        time.sleep(1.0)
        result["acrobatics"] = [self.sport.FrontFlip(), self.sport.HandStand(True), self.sport.FrontJump()]

    def walking(self):
        before, codes = self.states[-1].position, set()
        for _ in range(30):
            codes.add(self.sport.Move(0.4, 0.0, 0.0))
            time.sleep(0.1)
        self.result["move"] = [sorted(codes), self.states[-1].mode]
        code, stopped_at = self.sport.StopMove(), self.states[-1].position
        time.sleep(1.5)
        self.result["stop"] = [code, self.states[-1].mode]
        self.result["moved_m"] = round(math.dist(before[:2], stopped_at[:2]), 3)
        self.result["after_stop_m"] = round(math.dist(stopped_at[:2], self.states[-1].position[:2]), 3)

    def settings(self):
        sport, result = self.sport, self.result
        result["settings"] = [sport.SpeedLevel(-1), sport.SwitchJoystick(True), sport.TrotRun(), sport.StaticWalk(),
                              sport.ClassicWalk(True), sport.StopMove()]  # fmt: skip
        result["auto_recovery"] = [sport.AutoRecoverySet(True), list(sport.AutoRecoveryGet()),
                                   sport.AutoRecoverySet(False), list(sport.AutoRecoveryGet())]  # fmt: skip
        services = self.robot.ServiceList()[1]
        result["services"] = {service.name: [service.status, service.protect] for service in services}
        result["switch_protected"] = self.robot.ServiceSwitch("motion_switcher", False)
        result["versions"] = [client.GetServerApiVersion()[1] for client in (self.sport, self.avoid, self.switcher)]

    def avoidance(self):
        avoid, result = self.avoid, self.result
        result["avoid_switch"] = [list(avoid.SwitchGet()), avoid.SwitchSet(False), list(avoid.SwitchGet()),
                                  avoid.SwitchSet(True), avoid.UseRemoteCommandFromApi(True)]  # fmt: skip
        before = self.states[-1].position
        for _ in range(20):
            avoid.Move(0.4, 0.0, 0.0)
            time.sleep(0.1)
        result["avoid_moved_m"] = round(math.dist(before[:2], self.states[-1].position[:2]), 2)
        self.sport.StopMove()
        time.sleep(1.0)
        before = self.states[-1].position
        avoid.MoveToIncrementPosition(0.5, 0.0, 0.0)
        time.sleep(4.0)
        result["avoid_increment_m"] = round(math.dist(before[:2], self.states[-1].position[:2]), 2)

    def leases(self):
        command = [sys.executable, __file__, str(self.domain), self.interface, "--hold-lease"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
            for line in holder.stdout:
                if line.startswith("codes "):
                    self.result["lease_holder"] = json.loads(line[6:])
                    break
            self.result["lease_others"] = self.sport.StopMove()
            self.result["lease_question"] = list(self.sport.AutoRecoveryGet())
            holder.stdin.close()
        time.sleep(1.5)
        self.result["lease_after"] = self.sport.StopMove()

    def rates(self):
        result, round_trips = self.result, []
        for _ in range(500):
            start = time.perf_counter()
            assert self.sport.StopMove() == 0
            round_trips.append((time.perf_counter() - start) * 1e3)
            time.sleep(0.005)
        result["rtt_ms"] = {name: percentile(round_trips, share) for name, share in
                            (("p50", 0.5), ("p95", 0.95), ("p99", 0.99), ("max", 1.0))}  # fmt: skip
        count_low, count_state, start = len(self.lows), len(self.states), time.perf_counter()
        time.sleep(5)
        elapsed_s = time.perf_counter() - start
        result["low_state_hz"] = round((len(self.lows) - count_low) / elapsed_s, 1)
        result["sport_state_hz"] = round((len(self.states) - count_state) / elapsed_s, 1)
        images_ms, codes = [], set()
        for _ in range(40):
            start = time.perf_counter()
            code, data = self.video.GetImageSample()
            codes.add(code)
            images_ms.append((time.perf_counter() - start) * 1e3)
            time.sleep(0.1)
        picture = cv2.imdecode(np.frombuffer(bytes(data), np.uint8), cv2.IMREAD_COLOR)
        result["image"] = [sorted(codes), len(data), list(picture.shape), round(float(picture.std()), 1)]
        crc, sample = CRC(), self.lows[-20:]
        result["low_state_crc_ok"] = [sum(crc.Crc(low) == low.crc for low in sample), len(sample)]
        result["image_ms"] = {name: percentile(images_ms, share) for name, share in
                              (("p50", 0.5), ("p95", 0.95), ("max", 1.0))}  # fmt: skip

    def low_level(self):
        result, switcher = self.result, self.switcher
        result["mode_name"] = switcher.CheckMode()[1]["name"]
        result["stand_down"] = [self.sport.StandDown(), self.until_mode(5)]
        result["release"] = [switcher.ReleaseMode()[0], switcher.CheckMode()[1]["name"], switcher.SelectMode("mcf")[0]]
        result["sport_while_released"] = self.sport.StandUp()
        time.sleep(0.3)
        self.command_joints(wrong_crc=True)
        result["height_after_wrong_crc_m"] = round(self.states[-1].body_height, 2)
        self.command_joints(wrong_crc=False)
        result["height_after_low_commands_m"] = round(self.states[-1].body_height, 2)
        time.sleep(2.0)
        result["select"] = [switcher.SelectMode("ballet")[0], switcher.SelectMode("mcf")[0], self.sport.RecoveryStand(),
                            self.until_mode(1)]  # fmt: skip

    def command_joints(self, wrong_crc):
        """Lead the joints to a stand in 1.5 s and hold it for 0.5 s, 500 commands a second, as the maker's example."""
        command, crc = unitree_go_msg_dds__LowCmd_(), CRC()
        command.head[0], command.head[1], command.level_flag, command.gpio = 0xFE, 0xEF, 0xFF, 0
        for motor in command.motor_cmd:
            motor.mode, motor.q, motor.kp, motor.dq, motor.kd, motor.tau = 0x01, 2.146e9, 0.0, 16000.0, 0.0, 0.0
        begin = [motor.q for motor in self.lows[-1].motor_state[:JOINTS]]
        start = time.perf_counter()
        while (elapsed := time.perf_counter() - start) < 2.0:
            share = min(elapsed / 1.5, 1.0)
            for motor, first, last in zip(command.motor_cmd, begin, STAND, strict=False):
                motor.q, motor.dq, motor.kp, motor.kd = first + share * (last - first), 0.0, 90.0, 2.5
            command.crc = crc.Crc(command) ^ int(wrong_crc)
            self.low_commands.Write(command)
            time.sleep(0.002)


def main():
    domain, interface = int(sys.argv[1]), sys.argv[2]
    if "--hold-lease" in sys.argv:
        hold_lease(domain, interface)
        return
    sys.stdout.write(json.dumps(Session(domain, interface).run()) + "\n")


if __name__ == "__main__":
    main()
