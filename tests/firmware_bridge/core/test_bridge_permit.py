"""The operator's permission and the latch by themselves: what gives, keeps, ends and voids them."""

from __future__ import annotations

import pytest

from firmware_bridge.core.permit import PERMIT_NS, WAITING_NS, OperatorPermit

T0 = 10**12


def asked(required: bool = True, latch: str = "") -> OperatorPermit:
    """A permission whose runner has asked to arm at T0."""
    permit = OperatorPermit(required, latch)
    permit.ask(T0)
    return permit


def given(required: bool = True, latch: str = "") -> OperatorPermit:
    permit = asked(required, latch)
    assert permit.give(T0)
    return permit


def test_without_a_latch_and_where_none_is_required_none_is_needed() -> None:
    permit = OperatorPermit(required=False)
    assert permit.allows(T0) and permit.state(T0) == "not needed" and permit.latch == ""


@pytest.mark.parametrize("permit", [OperatorPermit(required=True), OperatorPermit(required=False, latch="pressed")])
def test_at_first_nothing_is_permitted_and_no_runner_waits(permit: OperatorPermit) -> None:
    assert not permit.allows(T0) and permit.state(T0) == "needed"
    assert not permit.give(T0) and not permit.allows(T0)


def test_an_arm_is_taken_until_three_seconds_after_the_runners_request() -> None:
    assert asked().give(T0 + WAITING_NS)
    late = asked()
    assert not late.give(T0 + WAITING_NS + 1) and not late.allows(T0)
    assert WAITING_NS == 3_000_000_000


def test_it_lasts_ten_seconds() -> None:
    permit = given()
    assert permit.allows(T0 + PERMIT_NS) and permit.state(T0 + PERMIT_NS) == "given"
    assert not permit.allows(T0 + PERMIT_NS + 1) and permit.state(T0 + PERMIT_NS + 1) == "needed"
    assert PERMIT_NS == 10_000_000_000


def test_it_does_not_expire_once_its_arming_has_sent_a_request() -> None:
    permit = given()
    permit.use()
    permit.begin()
    assert permit.allows(T0 + 60 * PERMIT_NS) and permit.state(T0 + 60 * PERMIT_NS) == "given"


def test_it_serves_one_request_of_the_runner() -> None:
    permit = given()
    permit.use()
    assert not permit.give(T0)


def test_an_arming_that_needed_none_leaves_none_for_an_emergency_stop_during_it() -> None:
    permit = OperatorPermit(required=False)
    permit.begin()
    permit.hold("pressed")
    assert not permit.allows(T0)
    permit = OperatorPermit(required=False)
    permit.begin()
    permit.latch = "pressed"  # whatever latches it
    assert not permit.allows(T0)


def test_the_armed_robot_ends_latch_and_permission() -> None:
    permit = given(required=True, latch="pressed")
    permit.begin()
    permit.finish()
    assert permit.latch == "" and not permit.allows(T0)


@pytest.mark.parametrize("disconnected", [False, True])
def test_a_void_permission_is_gone_also_during_its_arming(disconnected: bool) -> None:
    for begun in (False, True):
        permit = given()
        if begun:
            permit.begin()
        permit.void(disconnected=disconnected)
        assert not permit.allows(T0)


def test_a_connected_runner_still_waits_after_a_void_one_that_has_gone_does_not() -> None:
    permit = given()
    permit.void()
    assert permit.give(T0)
    permit.void(disconnected=True)
    assert not permit.give(T0)


def test_the_first_reason_of_an_emergency_stop_stays_and_voids_the_permission() -> None:
    permit = given()
    permit.hold("first")
    assert not permit.allows(T0)
    permit.hold("second")
    assert permit.latch == "first" and permit.is_needed
