"""Faults that the runner itself detects: its inputs, its model, its machine."""

from __future__ import annotations

from edge.safety.faults.row import Action, Escalation, Fault

_HERE = "runner"
_LOOP = "tests/edge/run/test_control_loop_faults.py::test_"
_STOPPED = _LOOP + "the_robot_stops_in_time_and_drives_again_unless_the_fault_latches"
_LIMITED = _LOOP + "the_speed_is_limited_in_time"
_ONCE = _LOOP + "once_it_is_found_and_the_robot_drives_on"
_ROBOT = "tests/edge/robot/test_inputs.py::test_"

INPUTS: tuple[Fault, ...] = (
    Fault(
        "camera-stopped", 1, Action.ZERO, 500, _HERE,
        "There is no new picture.",
        "Check the camera's cable and service; driving resumes 1 s after pictures arrive again.",
        _STOPPED + "[camera-stopped]",
    ),
    Fault(
        "camera-frozen", 2, Action.ZERO, 500, _HERE,
        "The camera repeats pictures, or its scene stays the same, although the robot has moved.",
        "If the robot did not slip on the spot, restart the camera service; driving resumes when the scene changes.",
        _STOPPED + "[camera-frozen]",
    ),
    Fault(
        "camera-stale", 3, Action.ZERO, 300, _HERE,
        "Pictures are more than 300 ms old on arrival, too old for driving.",
        "Check for a queue or a slow network between camera and runner.",
        _STOPPED + "[camera-stale]",
    ),
    Fault(
        "camera-from-future", 4, Action.ZERO, 300, _HERE,
        "A picture carries a stamp in the future.",
        "Check the source of the stamps: they must be of this machine's monotonic clock.",
        _STOPPED + "[camera-from-future]",
    ),
    Fault(
        "camera-slow", 5, Action.LIMIT, 1000, _HERE,
        "The camera sends far fewer pictures than it should.",
        "Check for load on the robot's computer or network; the robot drives at half speed.",
        _LIMITED + "[camera-slow]",
        speed_scale=0.5,
    ),
    Fault(
        "camera-too-slow", 5, Action.ZERO, 2000, _HERE,
        "The camera sends less than 40 % of its pictures.",
        "Check for load on the robot's computer or network.",
        _STOPPED + "[camera-too-slow]",
    ),
    Fault(
        "frame-refused", 6, Action.LIMIT, 500, _HERE,
        "A picture was black, saturated, torn or of the wrong size and was not used.",
        "Nothing to do unless it recurs: then clean or replace the camera.",
        _ONCE + "[frame-refused black]",
    ),
    Fault(
        "frames-refused", 6, Action.ZERO, 500, _HERE,
        "Three pictures in a row were black, saturated, torn or of the wrong size.",
        "Uncover or clean the lens, check the light, then the camera's cable.",
        _STOPPED + "[frames-refused black]",
    ),
    Fault(
        "camera-swapped", 7, Action.STOP, 2000, _HERE,
        "The pictures have another size than at the start: it is another camera or another setting.",
        "Put the camera back that the robot was calibrated with and start the runner again.",
        _STOPPED + "[camera-swapped]",
    ),
    Fault(
        "odometry-jump", 8, Action.ZERO, 100, _HERE,
        "The robot's pose jumped further than the robot can move; the sample was not used.",
        "Driving resumes by itself; a second jump stops the run.",
        _ROBOT + "one_jump_of_the_pose_stops_the_robot_for_a_second",
        escalation=Escalation("odometry-jumps", 2, 10_000),
    ),
    Fault(
        "odometry-jumps", 8, Action.STOP, 100, _HERE,
        "The robot's pose jumped twice within 10 s.",
        "Check the robot's feet, IMU and firmware before arming again.",
        _ROBOT + "two_jumps_of_the_pose_within_ten_seconds_stop_the_run",
    ),
    Fault(
        "odometry-frozen", 9, Action.ZERO, 700, _HERE,
        "The robot is commanded to move and its pose does not change.",
        "Check that the robot stands free and that its state is not frozen; unless recoveries are off, it drives back "
        "along its own path first. Staying again within 10 s without 5 cm of motion stops the run.",
        _ROBOT + "a_pose_that_stays_while_the_robot_is_told_to_walk_stops_it_for_a_second",
    ),
    Fault(
        "odometry-stays-frozen", 9, Action.STOP, 700, _HERE,
        "The robot was commanded to move twice within 10 s and its pose did not change.",
        "Free the robot, or restart it if it is free and its pose stands still, before arming again.",
        _ROBOT + "a_pose_that_stays_for_good_is_tried_twice_and_then_stops_the_run",
    ),
    Fault(
        "robot-blocked", 9, Action.ZERO, 700, _HERE,
        "The robot does not move as commanded, and its pose has changed since the last time: something blocks it.",
        "Unless recoveries are off, it drives back along its own path and tries again; the fifth time within 60 s "
        "stops the run.",
        _ROBOT + "a_robot_that_is_blocked_again_and_again_is_stopped_the_fifth_time",
        escalation=Escalation("robot-stays-blocked", 5, 60_000),
    ),
    Fault(
        "robot-stays-blocked", 9, Action.STOP, 700, _HERE,
        "The robot was blocked five times within 60 s.",
        "Free the robot before arming again.",
        _ROBOT + "a_robot_that_is_blocked_again_and_again_is_stopped_the_fifth_time",
    ),
    Fault(
        "odometry-not-finite", 10, Action.ZERO, 60, _HERE,
        "The robot reports a pose or velocity that is not finite or not possible.",
        "If it persists, restart the robot.",
        _ROBOT + "a_pose_that_is_not_finite_stops_the_robot_within_its_bound",
    ),
    Fault(
        "odometry-late", 11, Action.LIMIT, 300, _HERE,
        "The robot's pose arrives late.",
        "Check for load on the network to the robot; the robot drives at half speed.",
        _ROBOT + "reports_that_stay_late_limit_the_speed_for_as_long_as_they_do",
        speed_scale=0.5,
    ),
    Fault(
        "odometry-stale", 11, Action.ZERO, 300, _HERE,
        "The robot's pose is too old for driving.",
        "Check the cable to the robot and that the robot is on.",
        _STOPPED + "[odometry-stale]",
    ),
    Fault(
        "odometry-speed-mismatch", 12, Action.STOP, 300, _HERE,
        "Two measurements of the robot's speed or of its turning disagree.",
        "Check for slipping feet, a stuck gyro and a wrong velocity frame in the robot file before arming again.",
        _ROBOT + "two_speeds_that_disagree_stop_the_run_within_their_bound",
    ),
    Fault(
        "link-lossy", 35, Action.LIMIT, 2000, _HERE,
        "Many of the robot's state messages are lost.",
        "Use the cable, not the radio; the robot drives at half speed.",
        _ROBOT + "half_of_the_states_lost_from_the_start_limits_the_speed",
        speed_scale=0.5,
    ),
    Fault(
        "tipped-over", 64, Action.STOP, 100, _HERE,
        "The robot leans by more than 30°: it was pushed, lifted or has fallen.",
        "Put it on its feet by hand, check for damage, then arm again.",
        _LOOP + "a_robot_that_tips_over",
    ),
    Fault(
        "battery-low", 50, Action.LIMIT, 5000, _HERE,
        "The battery is low.",
        "Bring the robot home; it drives at half speed.",
        _LIMITED + "[battery-low]",
        clear_ms=10_000,
        speed_scale=0.5,
    ),
    Fault(
        "battery-empty", 50, Action.STOP, 5000, _HERE,
        "The battery is nearly empty.",
        "Let the robot sit down with its remote and charge it.",
        _STOPPED + "[battery-empty]",
    ),
)  # fmt: skip

MODEL: tuple[Fault, ...] = (
    Fault(
        "output-not-finite", 13, Action.ZERO, 40, _HERE,
        "The action expert's output is not finite, or missing.",
        "If it persists, verify the artifacts: edge-export verify DIR.",
        _LOOP + "an_output_that_is_not_finite",
        clear_ms=500,
    ),
    Fault(
        "output-out-of-range", 14, Action.LIMIT, 100, _HERE,
        "The action expert planned far more speed than the limit; the command was cut to the limit.",
        "Nothing to do unless it recurs.",
        _ONCE + "[output-out-of-range]",
        escalation=Escalation("output-out-of-range-often", 5, 1000),
    ),
    Fault(
        "output-out-of-range-often", 14, Action.STOP, 1000, _HERE,
        "The action expert planned far more speed than the limit five times within 1 s.",
        "Do not drive with these artifacts: verify them, then check the flight log.",
        _STOPPED + "[output-out-of-range-often]",
    ),
    Fault(
        "output-unsteady", 15, Action.LIMIT, 1000, _HERE,
        "The action expert's plan changes faster than the robot may follow.",
        "Check the flight log; the robot drives at half speed.",
        _LOOP + "plans_that_change_sides[output-unsteady]",
        speed_scale=0.5,
    ),
    Fault(
        "output-oscillating", 15, Action.ZERO, 1000, _HERE,
        "The action expert's output swings from one side to the other at every tick.",
        "Check the flight log before driving again with these artifacts.",
        _LOOP + "plans_that_change_sides[output-oscillating]",
    ),
    Fault(
        "output-constant", 16, Action.ZERO, 2500, _HERE,
        "The action expert repeats one plan although its picture has changed for 2 s.",
        "Verify the artifacts; a network that ignores its inputs must not drive.",
        _STOPPED + "[output-constant]",
    ),
    Fault(
        "semantic-old", 17, Action.LIMIT, 10_300, _HERE,
        "The semantic state is older than the policy was trained for; the speed falls with its age.",
        "Reasoning is slow: allow fewer tokens or more power.",
        _LIMITED + "[semantic-old]",
    ),
    Fault(
        "semantic-expired", 17, Action.ZERO, 15_300, _HERE,
        "The semantic state is too old for driving.",
        "Driving resumes with the next generation; a call that hangs is interrupted.",
        _STOPPED + "[semantic-expired]",
    ),
    Fault(
        "reasoning-failed", 18, Action.LIMIT, 300, _HERE,
        "A generation failed; the next one is tried.",
        "Nothing to do unless it recurs.",
        _ONCE + "[reasoning-failed]",
        escalation=Escalation("reasoning-failing", 5, 60_000),
    ),
    Fault(
        "reasoning-failing", 18, Action.STOP, 300, _HERE,
        "Reasoning failed five times within 60 s.",
        "Verify the artifacts and check the memory in use: edge-doctor.",
        _STOPPED + "[reasoning-failing]",
    ),
    Fault(
        "reasoning-hung", 17, Action.STOP, 30_300, _HERE,
        "The reasoning hangs in a call that an interrupt does not end.",
        "The runner ends and its service starts it again; check the kernel log for the accelerator's driver.",
        "tests/edge/safety/test_watchdog.py::test_a_call_that_an_interrupt_does_not_end_is_given_up",
    ),
    Fault(
        "semantic-text-invalid", 19, Action.ZERO, 300, _HERE,
        "Three reasoning texts in a row do not follow the grammar.",
        "Check that the model belongs to these artifacts; driving resumes with its next valid text.",
        _LOOP + "three_invalid_texts",
    ),
    Fault(
        "instruction-injected", 20, Action.NOTHING, 0, _HERE,
        "A text tries to change the robot's limits.",
        "Nothing to do: no text can reach a limit.",
        _LOOP + "a_thousand_texts_leave_every_limit_as_it_is",
    ),
    Fault(
        "stop-phrase", 47, Action.STOP, 300, _HERE,
        "The instruction channel received a stop phrase.",
        "Find out why, then edge-bridge arm, then start a new run.",
        "tests/process/bridge/test_stop_phrase_process.py::"
        "test_without_a_bridge_that_this_user_can_reach_the_runner_stops_the_robot_itself",
    ),
    Fault(
        "semantic-delay-invalid", 21, Action.ZERO, 100, _HERE,
        "The semantic state carries a stamp in the future.",
        "Restart the runner; if it persists, report it with the flight log.",
        _LOOP + "a_semantic_state_from_the_future",
    ),
)  # fmt: skip

MACHINE: tuple[Fault, ...] = (
    Fault(
        "tick-late", 22, Action.LIMIT, 1000, _HERE,
        "The control loop is often late.",
        "Another program uses the processor: edge-doctor names it; the robot drives at half speed.",
        _LIMITED + "[tick-late]",
        speed_scale=0.5,
    ),
    Fault(
        "tick-overrun", 22, Action.ZERO, 300, _HERE,
        "The last pass of the control loop took longer than two periods.",
        "Another program uses the processor: edge-doctor names it.",
        _LOOP + "a_tick_that_takes_too_long_stops_the_robot_and_a_late_one_does_not",
    ),
    Fault(
        "wall-clock-moved", 33, Action.NOTHING, 0, _HERE,
        "The machine's date was changed.",
        "Nothing to do: control runs on the monotonic clock.",
        "tests/edge/safety/test_fault_table.py::test_control_code_never_reads_the_wall_clock",
    ),
    Fault(
        "suspended", 34, Action.STOP, 300, _HERE,
        "The machine slept while the robot was armed: all inputs are old.",
        "Turn suspend off on this machine, then arm again.",
        _STOPPED + "[suspended]",
    ),
    Fault(
        "clock-backwards", 34, Action.STOP, 300, _HERE,
        "The monotonic clock went backwards.",
        "Restart the machine; if it persists, its clock source is broken.",
        _LOOP + "a_clock_that_runs_backwards",
    ),
    Fault(
        "thermal-throttle", 48, Action.LIMIT, 2000, _HERE,
        "The machine is hot and has lowered its clocks.",
        "Let it cool: check fan and dust; the robot drives at half speed.",
        _LIMITED + "[thermal-throttle]",
        clear_ms=5000,
        speed_scale=0.5,
    ),
    Fault(
        "thermal-trip", 48, Action.STOP, 2000, _HERE,
        "The machine is about to switch itself off from heat.",
        "Let it cool down before arming again.",
        _STOPPED + "[thermal-trip]",
    ),
    Fault(
        "log-disk-full", 51, Action.NOTHING, 0, _HERE,
        "The flight log's disk is full: records are dropped and counted, driving continues.",
        "Free space before the next run.",
        "tests/edge/flightlog/test_recorder.py::test_a_disk_that_is_full_stops_writing_and_is_reported",
    ),
    Fault(
        "log-disk-stalled", 52, Action.NOTHING, 0, _HERE,
        "The flight log's disk hangs: records are dropped and counted, driving continues.",
        "Check the disk before the next run.",
        "tests/edge/flightlog/test_recorder.py::test_a_hanging_disk_costs_the_caller_records_not_time",
    ),
)  # fmt: skip
