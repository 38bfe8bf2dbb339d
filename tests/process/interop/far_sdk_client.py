"""Stands a Go2 up through a binding of the maker's C++ SDK; run by test_interop_far_sdk.py under that SDK's python.

usage: far_sdk_client.py INTERFACE. The last line on stdout is JSON. Imports nothing of ours.
"""

import json
import sys
import time

import unitree_interface

STAND = (0.0, 0.8, -1.55) * 4  # hip, thigh, calf


def until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def rests(robot):
    """Whether 10 samples in a row feel gravity and nothing else, with still joints."""
    for _ in range(10):
        low = robot.read_low_state()
        felt = sum(v * v for v in low.imu.accel) ** 0.5
        if abs(felt - 9.81) > 0.3 or max(map(abs, low.motor.dq[:12])) > 0.1:
            return False
        time.sleep(0.02)
    return True


def main():
    robot = unitree_interface.UnitreeInterface.create_go2(sys.argv[1])
    result = {"robot": robot.get_robot_name(), "motors": robot.get_num_motors()}
    result["low_state"] = until(lambda: any(robot.read_low_state().motor.q), 20)
    result["rests"] = until(lambda: rests(robot), 20)  # released joints let it drop the last bit
    low = robot.read_low_state()
    result["lying_q"] = [round(q, 2) for q in low.motor.q[:12]]
    result["accel_z"] = round(low.imu.accel[2], 1)
    result["odometry_before"] = [round(v, 3) for v in robot.read_odom_state().position]

    begin, start, changes, last = list(low.motor.q[:12]), time.perf_counter(), 0, None
    command = robot.create_zero_command()
    while (elapsed := time.perf_counter() - start) < 2.5:
        share = min(elapsed / 1.5, 1.0)
        command.q_target = [a + share * (b - a) for a, b in zip(begin, STAND, strict=True)]
        command.dq_target, command.tau_ff = [0.0] * 12, [0.0] * 12
        command.kp, command.kd = [90.0] * 12, [2.5] * 12
        robot.write_low_command(command)
        dq = tuple(robot.read_low_state().motor.dq[:12])
        changes, last = changes + (dq != last), dq
        time.sleep(0.001)
    result["low_state_hz_at_least"] = round(changes / elapsed, 1)
    low, odometry, remote = robot.read_low_state(), robot.read_odom_state(), robot.read_wireless_controller()
    result["standing_q_error"] = round(max(abs(a - b) for a, b in zip(low.motor.q, STAND, strict=False)), 3)
    result["torque_nm"] = round(max(map(abs, low.motor.tau_est[:12])), 1)
    result["odometry_after"] = [round(v, 3) for v in odometry.position]
    result["odometry_quat_norm"] = round(sum(v * v for v in odometry.quat) ** 0.5, 3)
    result["remote"] = [remote.lx, remote.ly, remote.rx, remote.ry, remote.keys]
    sys.stdout.write(json.dumps(result) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
