"""The safety argument as one property: no velocity beyond the limits, none without an armed bridge, none after a stop
without a new arm, none of a stale command, and after an emergency stop none without an operator's arm for a waiting
runner. Operator, remote, runner, robot and bridge act in any order (`bridge_world.py` checks every step).
"""

from __future__ import annotations

import math
import sys

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from firmware_bridge.core.link import Arm, BridgeStatus, Release, Stop, Velocity
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_world import L2, A, B, World

FORCED_STATUS = BridgeStatus(0, "armed", "driving", 0, 0, 0, (0.0, 0.0, 0.0), False)
SPEEDS = st.sampled_from((0.0, 0.5, -0.4, 0.8, 0.1 + 0.2, 1e9, -1e9, math.nan, math.inf, -math.inf, 5e-324))
AGES_MS = st.sampled_from((0, 10, 240, 250, 251, -1))
EVENTS = st.sampled_from(
    (
        *("nothing", "operator stops", "stop keys", "stick", "another client commands", "runner stops"),
        *("client changes", "client changes before the permission"),
    )
)
ENDS_MS = st.sampled_from((1, 19, 20, 90, 260, 510))


class BridgeMachine(RuleBasedStateMachine):
    """Each rule is one event; the bridge steps at least once in each."""

    rules_run = 0
    latched_runs = 0
    drives = 0

    def __init__(self) -> None:
        super().__init__()
        self.world = World()

    def _count(self) -> World:
        BridgeMachine.rules_run += 1
        BridgeMachine.latched_runs += self.world.rules.needs_operator
        BridgeMachine.drives += self.world.state == "armed"
        return self.world

    @initialize(operator_arm=st.booleans())
    def robot_file(self, operator_arm: bool) -> None:
        self.world = World(operator_arm=operator_arm)

    def teardown(self) -> None:
        self.world.end()

    # The runner

    @rule()
    def runner_connects(self) -> None:
        world = self._count()
        world.bench.client = True
        world.step()

    @precondition(lambda self: self.world.bench.client)
    @rule(parting=st.sampled_from(((), (Arm(),), (Stop(),), (Arm(), Arm()))), reconnects=st.booleans())
    def runner_disconnects(self, parting: tuple, reconnects: bool) -> None:
        """Its last messages may arrive in the step in which it has gone; the next runner may connect right after."""
        world = self._count()
        world.change_client(*parting, reconnects=reconnects)

    @precondition(lambda self: self.world.bench.client)
    @rule(message=st.sampled_from(((Arm(),), (Arm(),), (Stop(),), (Stop(), Arm()), (Release(),), (FORCED_STATUS,))))
    def runner_asks(self, message: tuple) -> None:
        self._count().step(*message)

    @precondition(lambda self: self.world.bench.client)
    @rule(vx=SPEEDS, vy=SPEEDS, wz=SPEEDS, age_ms=AGES_MS)
    def runner_commands(self, vx: float, vy: float, wz: float, age_ms: int) -> None:
        self._count().command(vx, vy, wz, age_ms)

    @precondition(lambda self: self.world.bench.client)
    @rule(entries=st.lists(st.tuples(st.integers(-2, 2), AGES_MS, SPEEDS), min_size=1, max_size=4))
    def runner_sends_a_queue(self, entries: list) -> None:
        """Commands that waited: repeated, out of order, old, or from the future."""
        self._count().command_queue(entries)

    @rule(person=st.sampled_from((True, True, False)))
    def runner_drives(self, person: bool) -> None:
        """A run from its start: nothing is wrong, and where an operator is needed, there is one (`person`)."""
        world = self._count()
        world.recover()
        for _ in range(30):
            world.step(Arm())
            if person and world.state not in ("arming", "armed"):
                world.step(operator=(Arm(),))
                world.step(Arm())
            world.command(0.8, 0.0, 0.3, 0)
            world.wait(90)
            if world.state == "armed":
                break
        assert world.state == "armed" or not person
        for _ in range(6):  # up to the limit
            world.command(0.8, 0.0, 0.3, 0)
            world.wait(90)

    # Persons

    @rule(message=st.sampled_from(((Arm(),), (Arm(),), (Stop(),), (Release(),), (Arm(), Stop()), (Release(), Arm()))))
    def operator_acts(self, message: tuple) -> None:
        self._count().step(operator=message)

    @rule(velocity=SPEEDS)
    def operators_socket_tries_to_drive(self, velocity: float) -> None:
        world = self._count()
        world.step(operator=(Velocity(2**40, world.bench.now_ns, velocity, 0.0, 0.0), FORCED_STATUS))

    @rule(between_ms=st.sampled_from((0, 20, 2_900, 3_100)), event=EVENTS, after_ms=st.sampled_from((0, 9_000, 10_100)))
    def operator_permits(self, between_ms: int, event: str, after_ms: int) -> None:
        """The runner asks, the operator permits, something happens, a runner asks again: in time or too late."""
        world = self._count()
        world.recover()
        world.step(Arm())
        if event == "client changes before the permission":
            world.change_client(Arm())
        world.stall(between_ms)
        world.step(operator=(Arm(),))
        if event == "operator stops":
            world.step(operator=(Stop(),))
        elif event == "stop keys":
            world.step(keys=L2 | B)
        elif event == "stick":
            world.step(stick=True)
        elif event == "another client commands":
            world.step(foreign="sport 1008")
        elif event == "runner stops":
            world.step(Stop())
        elif event == "client changes":
            world.change_client()
        world.stall(1_100)
        world.stall(after_ms)
        world.step(Arm())
        world.wait(20)

    @rule(keys=st.sampled_from((L2, B, L2 | B, A, L2 | A)), held_ms=st.sampled_from((0, 20, 100)))
    def keys_pressed(self, keys: int, held_ms: int) -> None:
        world = self._count()
        world.step(keys=keys)
        for _ in range(held_ms // 20):
            world.stall(20)
            world.step(keys=keys)

    @rule(first=st.sampled_from((L2, B)), spacing_ms=st.integers(0, 25))
    def stop_keys_one_after_the_other(self, first: int, spacing_ms: int) -> None:
        world = self._count()
        world.step(keys=first)
        world.wait(spacing_ms * 20)
        world.step(keys=L2 | B if spacing_ms % 2 else (L2 | B) & ~first)
        assert world.rules.held

    @rule()
    def stick_moved_or_forged(self) -> None:
        self._count().step(stick=True)

    @rule(pressed=st.booleans())
    def local_input(self, pressed: bool) -> None:
        world = self._count()
        world.gpio = pressed
        world.step()

    # The robot and its network

    @rule(fault=st.sampled_from(("silent", "tipped", "broken", "forged", "writes_fail")), on=st.booleans())
    def robot_fault(self, fault: str, on: bool) -> None:
        world = self._count()
        setattr(world, fault, on)
        world.step()

    @rule(leased=st.booleans())
    def lease_held_by_another_client(self, leased: bool) -> None:
        world = self._count()
        world.robot.leased = leased
        world.step()

    @rule(more=st.booleans())
    def publishers_change(self, more: bool) -> None:
        world = self._count()
        world.publishers = "2 publishers of rt/sportmodestate, expected 1" if more else None
        world.step()

    @rule(name=st.sampled_from(("sport 1008", "sport_lease 101")))
    def another_client_commands(self, name: str) -> None:
        self._count().step(foreign=name)

    @rule(mode=st.sampled_from((ids.MODE_IDLE, ids.MODE_BALANCE_STAND, ids.MODE_LIE_DOWN, ids.MODE_DAMPING)))
    def robot_changes_mode(self, mode: int) -> None:
        world = self._count()
        world.robot.change_mode(mode)
        world.step()

    @rule(percent=st.sampled_from((80, 80, 80, 3)))
    def battery(self, percent: int) -> None:
        world = self._count()
        world.bench.battery = percent
        world.step()

    @rule()
    def everything_is_well_again(self) -> None:
        self._count().recover()

    # Time and the machine

    @rule(ms=ENDS_MS)
    def time_passes(self, ms: int) -> None:
        self._count().wait(ms)

    @rule(ms=st.sampled_from((1, 21, 120, 251, 1_001, 3_001, 10_001)))
    def bridge_stalls(self, ms: int) -> None:
        self._count().stall(ms)

    @rule()
    def machine_sleeps(self) -> None:
        world = self._count()
        world.bench.asleep_ns += 200_000_000
        world.step()

    @rule()
    def bridge_is_killed_and_restarted(self) -> None:
        self._count().restart_bridge()

    @rule(message=st.sampled_from(((), (Arm(),))))
    def bridge_shuts_down_and_is_restarted(self, message: tuple) -> None:
        world = self._count()
        world.step(*message, shutdown=True)
        world.restart_bridge()


def run(max_examples: int) -> None:
    """Run the machine with 100 rules an example; the same every time."""
    World.core_steps = BridgeMachine.rules_run = BridgeMachine.latched_runs = BridgeMachine.drives = 0
    run_state_machine_as_test(
        BridgeMachine,
        settings=settings(
            max_examples=max_examples,
            stateful_step_count=100,
            deadline=None,
            derandomize=True,
            database=None,
            phases=(Phase.explicit, Phase.generate),
            suppress_health_check=list(HealthCheck),
        ),
    )
    found = (BridgeMachine.rules_run, World.core_steps, BridgeMachine.latched_runs, BridgeMachine.drives)
    sys.stdout.write("{} rules, {} core steps, {} rules while latched, {} while armed\n".format(*found))


def test_after_an_emergency_stop_nothing_moves_the_robot_without_an_operator() -> None:
    run(12)
    assert BridgeMachine.rules_run >= 800
    assert BridgeMachine.latched_runs > 150 and BridgeMachine.drives > 8  # neither half of the property is empty


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_same_over_a_hundred_thousand_steps() -> None:
    run(180)
    assert World.core_steps >= 100_000 and BridgeMachine.rules_run >= 13_000
    assert BridgeMachine.latched_runs > 2_400 and BridgeMachine.drives > 120
