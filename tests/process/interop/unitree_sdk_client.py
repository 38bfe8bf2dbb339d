"""Drives a Go2 with the maker's own Python SDK, unmodified; run by test_interop_unitree_sdk.py under the SDK's python.

usage: unitree_sdk_client.py DOMAIN INTERFACE JPEG_OUT. The last line on stdout is JSON. Imports nothing of ours.
"""

import json
import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from unitree_sdk2py.core.channel import ChannelFactoryInitialize, ChannelSubscriber
from unitree_sdk2py.go2.robot_state.robot_state_client import RobotStateClient
from unitree_sdk2py.go2.sport.sport_client import SportClient
from unitree_sdk2py.go2.video.video_client import VideoClient
from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowState_, SportModeState_
from unitree_sdk2py.utils.crc import CRC


def main() -> None:
    domain, interface, jpeg_out = int(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
    ChannelFactoryInitialize(domain, interface)
    states, lows = [], []
    state_channel = ChannelSubscriber("rt/sportmodestate", SportModeState_)
    state_channel.Init(states.append, 10)
    low_channel = ChannelSubscriber("rt/lowstate", LowState_)
    low_channel.Init(lows.append, 10)
    sport, video, robot = SportClient(), VideoClient(), RobotStateClient()
    for client in (sport, video, robot):
        client.SetTimeout(3.0)
        client.Init()

    result = {}
    deadline = time.monotonic() + 10
    while not (states and lows) and time.monotonic() < deadline:
        time.sleep(0.05)
    # The SDK waits for the server to find its request writer, not for its response reader: retry the first call.
    code, version = sport.GetServerApiVersion()
    for _ in range(3):
        if code != 0:
            code, version = sport.GetServerApiVersion()
    result["version"] = [code, version]
    code, services = robot.ServiceList()
    result["services"] = [code, [service.name for service in services or []]]
    result["mode_at_start"] = states[-1].mode
    result["stand_up"] = sport.StandUp()
    time.sleep(2.5)
    result["mode_after_stand_up"] = states[-1].mode
    result["balance_stand"] = sport.BalanceStand()
    time.sleep(0.5)
    result["mode_after_balance_stand"] = states[-1].mode
    result["body_height_m"] = round(states[-1].body_height, 3)

    before = states[-1].position
    move_codes = set()
    for _ in range(30):
        move_codes.add(sport.Move(0.4, 0.0, 0.0))
        time.sleep(0.1)
    moving = states[-1]
    result["move"] = sorted(move_codes)
    result["mode_while_moving"] = moving.mode
    result["speed_mps"] = round(math.hypot(moving.velocity[0], moving.velocity[1]), 3)
    result["stop_move"] = sport.StopMove()
    stopped_at = states[-1].position
    time.sleep(1.5)
    result["moved_m"] = round(math.dist(before[:2], stopped_at[:2]), 3)
    result["after_stop_m"] = round(math.dist(stopped_at[:2], states[-1].position[:2]), 3)
    result["mode_after_stop"] = states[-1].mode
    result["unknown_api"] = sport.BackFlip()

    round_trips = []
    for _ in range(50):
        start = time.perf_counter()
        assert sport.StopMove() == 0
        round_trips.append((time.perf_counter() - start) * 1e3)
    round_trips.sort()
    result["stop_move_rtt_ms"] = {"p50": round(round_trips[25], 2), "max": round(round_trips[-1], 2)}

    start = time.perf_counter()
    code, data = video.GetImageSample()
    result["image_ms"] = round((time.perf_counter() - start) * 1e3, 1)
    jpeg = bytes(data)
    jpeg_out.write_bytes(jpeg)
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    result["image"] = [code, len(jpeg), list(picture.shape), round(float(picture.std()), 1)]

    crc = CRC()
    sample = lows[-20:]
    result["low_state_crc_ok"] = [sum(crc.Crc(low) == low.crc for low in sample), len(sample)]
    count_low, count_state = len(lows), len(states)
    time.sleep(2)
    result["low_state_hz"] = round((len(lows) - count_low) / 2, 1)
    result["sport_state_hz"] = round((len(states) - count_state) / 2, 1)
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
