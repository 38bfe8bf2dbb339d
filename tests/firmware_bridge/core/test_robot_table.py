"""A protocol's modes and steps as data: what cannot be true is refused when it is built."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.support.robot.bridge_bench import TABLE


def test_a_ready_mode_in_which_an_armed_robot_may_not_be_is_refused() -> None:
    with pytest.raises(ValueError, match="ready modes"):
        replace(TABLE, ready_modes=TABLE.ready_modes | {99})


@pytest.mark.parametrize("change", [{"recovery_step": 99}, {"next_step": {5: 99}}])
def test_a_step_without_a_name_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected a name for each"):
        replace(TABLE, **change)


def test_a_mode_without_a_name_is_called_by_its_number() -> None:
    named = replace(TABLE, mode_names={5: "LIE_DOWN"})
    assert (named.name_of(5), named.name_of(6)) == ("mode LIE_DOWN", "mode 6")
