"""Faults that the bridge or the robot handles because the runner has failed, and faults that refuse a start."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from edge.safety.faults.row import Action, Fault

BRIDGE: tuple[Fault, ...] = (
    Fault(
        "commands-late", 22, Action.STOP, 300, "bridge",
        "The bridge got no good command in time.",
        "Another program uses the processor: edge-doctor names it; then arm again.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestDeadman::test_the_wire_is_zero_when_the_last_good_command_is_250_ms_old",
    ),
    Fault(
        "graph-hung", 23, Action.STOP, 300, "bridge",
        "A graph's run does not return (driver or GPU hang): no commands arrive.",
        "The watchdog restarts the runner; check the kernel log before arming again.",
        "tests/process/bridge/test_bridge_process.py::test_a_dead_or_frozen_runner_leaves_zero_on_the_wire",
    ),
    Fault(
        "out-of-memory", 26, Action.STOP, 300, "bridge",
        "The machine ran out of memory and the runner was killed.",
        "Find the program that used the memory (edge-doctor), then arm again.",
        "tests/process/test_edge_run.py::test_killed_while_driving_the_robot_gets_zero_within_300_ms",
    ),
    Fault(
        "runner-killed", 27, Action.STOP, 300, "bridge",
        "The runner was killed.",
        "Check its journal, then start and arm again.",
        "tests/process/test_edge_run.py::test_killed_while_driving_the_robot_gets_zero_within_300_ms",
    ),
    Fault(
        "control-thread-dead", 28, Action.STOP, 300, "bridge",
        "The runner runs but its control thread is dead: no commands arrive.",
        "The watchdog restarts the runner; report it with the journal.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestDeadman::test_the_wire_is_zero_when_the_last_good_command_is_250_ms_old",
    ),
    Fault(
        "runner-frozen", 29, Action.STOP, 300, "bridge",
        "The runner was frozen; its queued commands are refused by age and sequence.",
        "Find what stopped it, then arm again.",
        "tests/process/test_edge_run.py::test_frozen_while_driving_the_robot_gets_zero_within_300_ms_and_old_commands_stay_dead",
    ),
    Fault(
        "bridge-killed", 30, Action.STOP, 1200, "robot",
        "The bridge was killed: the robot itself drops a command after 1 s (simulated Go2; measure a real one).",
        "systemd starts the bridge again, disarmed; check its journal.",
        "tests/process/bridge/test_bridge_process.py::test_a_killed_bridges_successor_stops_the_moving_robot_first",
    ),
    Fault(
        "latch-lost", 30, Action.STOP, 0, "bridge",
        "The bridge was killed after an emergency stop: the next bridge reads the stop from its latch file.",
        "Find out why the stop was pressed, then run `edge-bridge arm` while a runner waits.",
        "tests/process/bridge/test_latch_restart.py::"
        "test_a_killed_bridges_successor_drives_no_runner_until_an_operator_arms",
    ),
    Fault(
        "bridge-hung", 31, Action.STOP, 1200, "robot",
        "The bridge hangs: the runner ends its run, the robot itself drops a command after 1 s.",
        "systemd's watchdog restarts the bridge, disarmed; check its journal.",
        "tests/edge/run/test_control_loop.py::test_a_bridge_that_has_gone_silent_ends_the_loop",
    ),
    Fault(
        "link-lost", 35, Action.STOP, 1300, "bridge",
        "The robot no longer sends anything.",
        "Check the cable to the robot and that the robot is on, then arm again.",
        "tests/firmware_bridge/core/test_bridge_dangers.py::test_without_the_robots_state_zero_goes_out_after_the_deadmans_time_and_the_state_is_not_latched",
    ),
    Fault(
        "message-reordered", 36, Action.NOTHING, 0, "bridge",
        "A command arrived twice or out of order and was dropped.",
        "Nothing to do.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestGate::test_a_sequence_number_that_does_not_increase_is_rejected",
    ),
    Fault(
        "state-from-future", 36, Action.NOTHING, 0, "bridge",
        "A report of the robot carried a stamp in the future and was dropped.",
        "Find the second publisher of the robot's state: another robot or a forger.",
        "tests/process/bridge/test_stop_means_stop.py::TestNotAlone::"
        "test_forged_states_with_future_stamps_do_not_hide_a_tipped_robot",
    ),
    Fault(
        "message-flood", 37, Action.NOTHING, 0, "bridge",
        "Old messages arrived in a burst and were dropped by their age.",
        "Nothing to do.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestDeadman::test_a_queue_of_old_commands_after_a_suspended_runner_is_refused",
    ),
    Fault(
        "late-motion", 38, Action.STOP, 40, "bridge",
        "A motion command overtook the stop; the stop was sent again.",
        "Nothing to do: the bridge keeps sending zero.",
        "tests/firmware_bridge/core/test_bridge_dangers.py::TestStopAgain::test_a_late_move_is_followed_by_a_zero_within_40_ms_whenever_it_comes",
    ),
    Fault(
        "stop-call-blocked", 39, Action.NOTHING, 0, "bridge",
        "The robot does not answer StopMove; the bridge has already sent zero velocity.",
        "If it persists, restart the robot.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestEveryStop::test_a_zero_move_and_then_a_stop_move_go_out_first",
    ),
    Fault(
        "second-commander", 40, Action.STOP, 500, "bridge",
        "Another client commands the robot.",
        "Close the other program or app; only one may command the robot.",
        "tests/process/bridge/test_bridge_process.py::test_a_second_commander_gets_the_robot_zeroed_and_the_bridge_latched",
    ),
    Fault(
        "lease-taken", 40, Action.STOP, 500, "bridge",
        "Another client requested the lease of the sport service, which shuts this bridge out.",
        "Close the other program or app; while the robot moves, stop it with L2 and B on its remote.",
        "tests/process/bridge/test_stop_means_stop.py::TestConfirmation::"
        "test_a_lease_request_while_driving_is_a_second_commander",
    ),
    Fault(
        "stop-denied", 40, Action.STOP, 0, "bridge",
        "Another client holds the lease: the robot denies the stop, and `edge-bridge stop` reports that it moves.",
        "Press L2 and B on the robot's remote, or switch the robot off.",
        "tests/process/bridge/test_stop_means_stop.py::TestConfirmation::"
        "test_a_robot_that_another_client_drives_on_is_never_confirmed",
    ),
    Fault(
        "second-publisher", 40, Action.STOP, 500, "bridge",
        "A second robot or a forger publishes on a topic that the bridge reads.",
        "Give each robot a network of its own; edge-bridge status names the topic.",
        "tests/process/bridge/test_stop_means_stop.py::TestNotAlone::"
        "test_two_robots_are_not_armed_and_a_second_one_stops_the_first",
    ),
    Fault(
        "motor-commands", 40, Action.STOP, 500, "bridge",
        "Another program publishes motor commands (rt/lowcmd), which bypass the sport service.",
        "End that program; where it is the robot's own, set safety.robot_lowcmd_publishers.",
        "tests/process/bridge/test_stop_means_stop.py::TestNotAlone::"
        "test_a_publisher_of_motor_commands_stops_a_driven_robot",
    ),
    Fault(
        "mavlink-forged", 41, Action.NOTHING, 0, "bridge",
        "Unsigned, forged or recorded MAVLink packets, or packets of another system, arrived and were dropped.",
        "Find the sender: edge-bridge counts its packets as malformed; sign the link (mavlink.signing_key).",
        "tests/firmware_bridge/mavlink/test_mavlink_session.py::TestSigning::test_forged_packets_change_nothing",
    ),
    Fault(
        "robot-mode-left", 42, Action.STOP, 1000, "bridge",
        "The robot left its driving modes by itself.",
        "Check the robot: it may have fallen or been taken over; then arm again.",
        "tests/firmware_bridge/core/test_bridge_core.py::TestEveryStop::test_a_zero_move_and_then_a_stop_move_go_out_first",
    ),
    Fault(
        "robot-error", 42, Action.STOP, 1000, "bridge",
        "The robot reports an error of its own.",
        "Find the error code in the maker's manual before arming again.",
        "tests/firmware_bridge/core/test_bridge_dangers.py::TestEveryDanger::test_it_stops_a_driven_robot_in_the_same_step",
    ),
    Fault(
        "can-bus-off", 43, Action.STOP, 100, "bridge",
        "The CAN controller is bus-off or error-passive: its error frames say so.",
        "Check wiring, termination and bit rate, then arm again.",
        "tests/firmware_bridge/can/test_can_supervision.py::"
        "test_an_error_frame_of_a_controller_in_trouble_stops_it_in_the_next_step",
    ),
    Fault(
        "can-frames-invalid", 44, Action.STOP, 160, "bridge",
        "Five frames of a CAN message in a row had a wrong CRC, counter or length.",
        "Check wiring and DBC file: edge-bridge status names the message; then arm again.",
        "tests/firmware_bridge/can/test_can_supervision.py::test_five_wrong_crcs_in_a_row_stop_the_robot_within_100_ms",
    ),
    Fault(
        "can-bus-overloaded", 45, Action.NOTHING, 0, "bridge",
        "The load of the CAN bus is above 80 %: commands may be late, and a base without commands stops by itself.",
        "Find the node that sends: the bridge's log names the most frequent unknown identifier.",
        "tests/firmware_bridge/can/test_can_supervision.py::test_a_babbling_node_is_named_to_the_operator",
    ),
    Fault(
        "robot-link-down", 46, Action.STOP, 100, "bridge",
        "Commands cannot be sent: the network to the robot is down or its queue is full.",
        "Check the interface or device that the robot file names; edge-doctor says what is missing.",
        "tests/firmware_bridge/core/test_bridge_dangers.py::TestEveryDanger::test_it_stops_a_driven_robot_in_the_same_step",
    ),
    Fault(
        "emergency-stop", 47, Action.STOP, 60, "bridge",
        "The emergency stop was pressed, or the remote took over.",
        "Find out why, release it, then arm again; after an emergency stop with `edge-bridge arm`.",
        "tests/process/bridge/test_bridge_process.py::test_a_hand_on_the_remote_is_zero_within_60_ms",
    ),
    Fault(
        "emergency-stop-latched", 47, Action.STOP, 0, "bridge",
        "An emergency stop was pressed while the robot was not driven: it latches in every state of the bridge.",
        "Find out why, then run `edge-bridge arm` while a runner waits.",
        "tests/firmware_bridge/core/test_bridge_model.py::test_after_an_emergency_stop_nothing_moves_the_robot_without_an_operator",
    ),
    Fault(
        "permission-expired", 47, Action.NOTHING, 0, "bridge",
        "An operator's arm was not used within 10 s, or its runner disconnected: it is void.",
        "Run `edge-bridge arm` again while a runner waits.",
        "tests/process/bridge/test_stop_means_stop.py::TestPermission::test_it_expires_after_ten_seconds",
    ),
)  # fmt: skip

START: tuple[Fault, ...] = (
    Fault(
        "provider-missing", 24, Action.STOP, 0, "start",
        "An execution provider that the artifacts need is not on this machine.",
        "Install it or export for this machine; the runner never falls back to the CPU by itself.",
        "tests/edge/artifacts/test_manifest.py::test_a_provider_that_this_machine_lacks_is_refused_by_name",
    ),
    Fault(
        "provider-partial", 25, Action.STOP, 0, "start",
        "The execution provider takes no part of a graph.",
        "Build the engines again with edge-install engines and read its output.",
        "tests/edge/deploy/test_doctor.py::test_only_nodes_that_compute_shapes_may_run_on_the_processor",
    ),
    Fault(
        "artifact-corrupt", 53, Action.STOP, 0, "start",
        "A file of the artifacts differs from its manifest entry.",
        "Copy or export the artifacts again.",
        "tests/edge/artifacts/test_manifest.py::test_a_damaged_directory_is_refused",
    ),
    Fault(
        "external-data", 54, Action.STOP, 0, "start",
        "A graph points to data outside the manifest's list.",
        "Do not use these artifacts: they were changed.",
        "tests/edge/artifacts/test_manifest.py::test_external_data_that_leaves_its_listed_file_is_refused",
    ),
    Fault(
        "manifest-changed", 55, Action.STOP, 0, "start",
        "The manifest has changed since the export, or its signature does not match.",
        "Use the artifacts as they were exported, with the key that they were signed with.",
        "tests/edge/artifacts/test_signature.py::test_a_manifest_that_was_changed_and_sealed_again_is_refused_before_it_is_parsed",
    ),
    Fault(
        "code-in-artifacts", 56, Action.STOP, 0, "start",
        "There is a file among the artifacts that the manifest does not list (a pickle could run code).",
        "Delete it, or export the artifacts again.",
        "tests/edge/artifacts/test_manifest.py::test_a_damaged_directory_is_refused[a file that is not listed]",
    ),
    Fault(
        "bad-configuration", 57, Action.STOP, 0, "start",
        "The robot file has an unknown key, or a value beyond what the robot allows.",
        "Correct the key that the message names.",
        "tests/firmware_bridge/core/test_robot_config.py::test_a_wrong_file_is_refused_in_one_line",
    ),
    Fault(
        "interface-absent", 46, Action.STOP, 0, "start",
        "The interface or device of the robot's link is absent: the bridge waits, and keeps an emergency stop.",
        "Plug in the robot's cable or adapter, or correct its name in the robot file.",
        "tests/firmware_bridge/test_bridge_late_interface.py::TestProcess::test_it_serves_once_the_interface_appears",
    ),
    Fault(
        "wrong-robot", 58, Action.STOP, 0, "start",
        "The robot file is for another robot or protocol.",
        "Name the file of the robot that is connected.",
        "tests/firmware_bridge/core/test_bridge_dangers.py::TestIdentity::test_another_robot_is_refused_before_anything_moves",
    ),
    Fault(
        "unsafe-robot", 58, Action.STOP, 0, "start",
        "The robot's own protection, such as a failsafe parameter, is weaker than the robot file requires.",
        "Correct on the robot what edge-bridge status names, then start the runner again.",
        "tests/edge/robot/test_operator_arm.py::TestBridge::test_a_robot_whose_own_protection_is_weak_is_not_armed",
    ),
    Fault(
        "restart-storm", 59, Action.STOP, 0, "start",
        "The runner failed five times in a row and is not started again.",
        "Check its journal: journalctl -u tic-vla-edge-runner.",
        "tests/edge/deploy/test_units.py::test_slow_failing_starts_of_the_runner_are_counted_within_one_window",
    ),
    Fault(
        "upgrade-interrupted", 60, Action.STOP, 0, "start",
        "Writing the artifacts was interrupted: the old ones are still there.",
        "Export again.",
        "tests/export/pipeline/test_export_directory.py::test_the_directory_that_a_killed_export_replaced_is_restored",
    ),
)  # fmt: skip

FAULT_OF_CAUSE: Mapping[str, str] = MappingProxyType(
    {
        "deadman": "commands-late",
        "suspended": "suspended",
        "estop": "emergency-stop",
        "remote_takeover": "emergency-stop",
        "second_commander": "second-commander",
        "second_publisher": "second-publisher",
        "link_down": "robot-link-down",
        "state_silent": "link-lost",
        "wrong_mode": "robot-mode-left",
        "robot_error": "robot-error",
        "tipped": "tipped-over",
        "robot_moving": "bridge-killed",
        "wrong_robot": "wrong-robot",
        "unsafe_robot": "unsafe-robot",
    }
)
"""Fault of each cause of a bridge's stop (firmware_bridge.core.link.CAUSES)."""
