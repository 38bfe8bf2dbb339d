"""What the services of the simulated Go2 do: leases, postures, gaits, switching; by rule, without a wire."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.protocols.unitree.services.postures import SHOWS
from sim_hil.protocols.unitree.services.service import (
    APPLY,
    RENEW,
    Lease,
    parse_flag,
    parse_numbers,
    parse_table,
    parse_text,
)
from sim_hil.protocols.unitree.services.switching import BUSY_S, Vui
from tests.support.robot.go2_services import Desk, Stage

S = 1_000_000_000


class TestLease:
    @staticmethod
    def apply(lease: Lease, now_ns: int) -> tuple[int, str]:
        return lease.handle(APPLY, '{"name": "host/sport/1"}', 0, now_ns)

    def test_only_the_holder_is_obeyed(self) -> None:
        lease = Lease()
        assert not lease.denies(0, S) and lease.denies(5, S)
        code, data = self.apply(lease, S)
        given_id = json.loads(data)["id"]
        assert (code, json.loads(data)["term"]) == (0, 1_000_000)
        assert not lease.denies(given_id, S + 1)
        assert lease.denies(0, S + 1) and lease.denies(given_id + 1, S + 1)

    def test_a_second_application_is_refused(self) -> None:
        lease = Lease()
        self.apply(lease, S)
        assert self.apply(lease, S + S // 2) == (3207, "")

    def test_it_ends_a_second_after_it_was_last_renewed(self) -> None:
        lease = Lease()
        held = json.loads(self.apply(lease, S)[1])["id"]
        assert lease.handle(RENEW, "{}", held, S + 9 * S // 10) == (0, "")
        assert not lease.denies(held, S + 18 * S // 10)
        assert lease.denies(held, S + 20 * S // 10) and not lease.denies(0, S + 20 * S // 10)
        assert lease.handle(RENEW, "{}", held, S + 20 * S // 10) == (3206, "")
        assert self.apply(lease, S + 21 * S // 10)[0] == 0

    @pytest.mark.parametrize(
        ("api_id", "text", "code"),
        [(RENEW, "{}", 3206), (103, "{}", 3203), *[(APPLY, text, 3204) for text in ("", "[]", "{", "1")]],
    )
    def test_an_invalid_request_has_its_code(self, api_id: int, text: str, code: int) -> None:
        assert Lease().handle(api_id, text, 0, S) == (code, "")


class TestParameters:
    @pytest.mark.slow
    @given(st.text(max_size=100))
    def test_no_text_breaks_a_reader(self, text: str) -> None:
        assert parse_table(text) is None or isinstance(parse_table(text), dict)
        parse_numbers(text, "x"), parse_flag(text, "x"), parse_text(text, "x")

    @pytest.mark.parametrize(("text", "value"), [("true", True), ("0", False), ("1", True), ("2", None), ('"1"', None)])
    def test_a_flag_is_a_truth_value_or_0_or_1(self, text: str, value: bool | None) -> None:
        assert parse_flag(f'{{"on": {text}}}', "on") is value


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.simulation.close()


@pytest.fixture
def desk() -> Desk:
    return Desk()


class TestPostures:
    @pytest.mark.parametrize(("api_id", "name"), [(1016, "Hello"), (1017, "Stretch"), (1020, "Content"),
                                                  (1022, "Dance1"), (1023, "Dance2")])  # fmt: skip
    def test_a_show_is_played_reported_and_ends_in_a_stand(self, desk: Desk, api_id: int, name: str) -> None:
        assert desk.ask(api_id) == (0, "")
        desk.run(1.0)
        assert (desk.behaviour.mode, desk.behaviour.progress) == (2, 1.0)
        assert desk.ask(api_id)[0] == 4202  # one at a time
        desk.run(sum(frame[0] for frame in SHOWS[name].keyframes))
        assert (desk.behaviour.mode, desk.behaviour.progress) == (1, 0.0)
        assert desk.behaviour.ready

    @pytest.mark.slow
    def test_it_stands_on_three_legs_while_it_waves_and_does_not_fall(self, stage: Stage) -> None:
        stage.ask(1016)
        lowest = []
        stage.run(5.0, lambda: lowest.append(stage.simulation.robot.up()))
        assert min(lowest) > 0.9 and stage.behaviour.mode == 1
        assert math.hypot(*stage.pose().as_tuple()[:2]) < 0.1

    @pytest.mark.slow
    def test_it_sits_ignores_velocities_and_rises(self, stage: Stage) -> None:
        assert stage.ask(1009) == (0, "")
        stage.run(2.0)
        assert stage.behaviour.mode == 10 and stage.tilt[1] < -0.3
        where = stage.pose()
        stage.run(1.0, lambda: stage.ask(1008, x=0.5, y=0, z=0))
        assert math.hypot(stage.pose().x_m - where.x_m, stage.pose().y_m - where.y_m) < 0.05
        assert stage.ask(1010) == (0, "")
        stage.run(1.5)
        assert stage.behaviour.mode == 1 and abs(stage.tilt[1]) < 0.1

    @pytest.mark.slow
    @pytest.mark.parametrize(("axis", "angle"), [("x", 0.4), ("z", -0.4)])
    def test_euler_turns_the_body_and_zero_turns_it_back(self, stage: Stage, axis: str, angle: float) -> None:
        before = stage.tilt
        stage.ask(1007, **{"x": 0, "y": 0, "z": 0, axis: angle})
        stage.run(2.0)
        turned = dict(zip("xyz", np.subtract(stage.tilt, before), strict=True))
        assert turned.pop(axis) == pytest.approx(angle, abs=0.12)
        assert all(abs(other) < 0.1 for other in turned.values()) and stage.behaviour.mode == 1
        stage.ask(1007, x=0, y=0, z=0)
        stage.run(1.5)
        assert np.allclose(stage.tilt, before, atol=0.1)

    @pytest.mark.slow
    def test_a_velocity_ends_a_turned_body_and_is_obeyed_for_a_second(self, stage: Stage) -> None:
        stage.ask(1007, x=0.3, y=0, z=0)
        stage.run(1.5)
        stage.ask(1008, x=0.5, y=0, z=0)
        stage.run(1.0)
        assert stage.behaviour.commanded == (0.0, 0.0, 0.0)
        where = stage.pose()
        stage.run(2.5, lambda: stage.ask(1008, x=0.5, y=0, z=0))
        assert stage.pose().x_m - where.x_m > 0.4

    @pytest.mark.slow
    def test_a_pose_keeps_its_mode_however_it_is_turned_until_it_is_ended(self, stage: Stage) -> None:
        stage.ask(1028, data=True)
        stage.run(1.5)
        stage.ask(1007, x=0.3, y=0, z=0)
        stage.run(1.0)
        assert stage.behaviour.mode == 2 and stage.tilt[0] > 0.2
        stage.ask(1028, data=False)
        stage.run(1.5)
        assert stage.behaviour.mode == 1

    @pytest.mark.parametrize("api_id", [1009, 1016, 1028])
    def test_postures_are_refused_while_lying(self, desk: Desk, api_id: int) -> None:
        desk.ask(1005)
        desk.run(2.0)
        assert desk.ask(api_id, data=True) == (4202, "")

    @pytest.mark.parametrize("api_id", [1029, 1030, 1031, 1032, 1036, 2041, 2043, 2044, 2046, 2047, 2050, 2051])
    def test_acrobatics_are_not_implemented_in_this_mode(self, desk: Desk, api_id: int) -> None:
        assert desk.ask(api_id, data=True) == (3203, "")

    @pytest.mark.parametrize(
        ("api_id", "parameter"),
        [(1007, {"x": 1}), (1008, {"x": 1, "y": 0}), (1015, {"data": 3}), (1027, {"data": "on"}), (1028, {}),
         (2048, {}), (2049, {}), (2054, {"data": 2})],
    )  # fmt: skip
    def test_an_invalid_parameter_has_its_error_code(
        self, desk: Desk, api_id: int, parameter: dict[str, object]
    ) -> None:
        assert desk.ask(api_id, **parameter) == (3204, "")

    def test_damp_ends_a_show_at_once(self, desk: Desk) -> None:
        desk.ask(1022)
        desk.run(1.5)
        assert desk.ask(1001) == (0, "")
        assert desk.behaviour.mode == 7


class TestGaits:
    def top_speed(self, desk: Desk) -> float:
        desk.run(2.5, lambda: desk.ask(1008, x=0.8, y=0, z=0))
        return desk.behaviour.commanded[0]

    def test_a_slow_gait_walks_slowly_and_is_reported(self, desk: Desk) -> None:
        assert desk.ask(1061) == (0, "")
        assert self.top_speed(desk) == pytest.approx(0.3)
        assert desk.behaviour.gait_type == 1
        assert desk.ask(1062) == (0, "")
        assert self.top_speed(desk) == pytest.approx(0.8)
        assert desk.behaviour.gait_type == 2

    def test_the_slow_speed_level_halves_a_velocity_until_a_stop_sets_it_back(self, desk: Desk) -> None:
        assert desk.ask(1015, data=-1) == (0, "")
        assert self.top_speed(desk) == pytest.approx(0.4)
        desk.ask(1003)
        desk.run(1.0)
        assert self.top_speed(desk) == pytest.approx(0.8)

    @pytest.mark.parametrize("enabled", [True, False])
    def test_a_fallen_robot_stands_up_by_itself_only_with_auto_recovery(self, desk: Desk, enabled: bool) -> None:
        assert desk.ask(2054, data=enabled) == (0, "") and json.loads(desk.ask(2055)[1]) == {"data": enabled}
        desk.measured = desk.measured._replace(up=0.1)
        desk.run(0.1)
        assert desk.behaviour.mode == 7
        desk.run(2.5)
        assert desk.behaviour.mode == (8 if enabled else 7)


class TestSwitching:
    def test_released_the_sport_service_refuses_everything(self, desk: Desk) -> None:
        assert desk.switcher.handle(1003, "{}") == (0, "")
        assert json.loads(desk.switcher.handle(1001, "{}")[1]) == {"form": "0", "name": ""}
        assert desk.behaviour.mode == 0
        for api_id in (1001, 1004, 1008, 1016, 1030):
            assert desk.ask(api_id, x=1, y=0, z=0) == (4202, "")

    def test_it_is_busy_for_a_while_after_a_release_and_limp_after_a_selection(self, desk: Desk) -> None:
        desk.switcher.release()
        assert desk.switcher.handle(1002, '{"name": "mcf"}') == (7002, "")
        desk.run(BUSY_S + 0.1)
        assert desk.switcher.handle(1002, '{"name": "mcf"}') == (0, "")
        assert json.loads(desk.switcher.handle(1001, "")[1])["name"] == "mcf"
        assert desk.behaviour.mode == 7
        assert desk.ask(1006) == (0, "")

    @pytest.mark.parametrize(("parameter", "code"), [("{}", 7001), ('{"name": 3}', 7001), ('{"name": "ballet"}', 7004)])
    def test_a_wrong_selection_has_its_code(self, desk: Desk, parameter: str, code: int) -> None:
        assert desk.switcher.handle(1002, parameter)[0] == code

    def test_silent_is_kept(self, desk: Desk) -> None:
        assert json.loads(desk.switcher.handle(1005, "")[1]) == {"silent": False}
        assert desk.switcher.handle(1004, '{"silent": true}') == (0, "")
        assert json.loads(desk.switcher.handle(1005, "")[1]) == {"silent": True}
        assert desk.switcher.handle(1004, "{}") == (7001, "")

    def test_the_sport_service_is_switched_off_as_by_a_release(self, desk: Desk) -> None:
        code, data = desk.robot_state.handle(1001, '{"name": "sport_mode", "switch": 0}')
        assert (code, json.loads(data)["status"]) == (0, 0)
        assert desk.behaviour.released
        status = {s["name"]: s["status"] for s in json.loads(desk.robot_state.handle(1003, "")[1])}
        assert status["sport_mode"] == 0 and status["robot_state"] == 1

    def test_a_protected_service_stays_on(self, desk: Desk) -> None:
        code, data = desk.robot_state.handle(1001, '{"name": "motion_switcher", "switch": 0}')
        assert (code, json.loads(data)["status"]) == (0, 5)

    @pytest.mark.parametrize(
        "parameter", ["", '{"name": "toaster", "switch": 1}', '{"name": "sport_mode"}', '{"name": 1, "switch": 1}']
    )
    def test_a_wrong_switch_is_a_parameter_error(self, desk: Desk, parameter: str) -> None:
        assert desk.robot_state.handle(1001, parameter) == (3204, "")

    def test_a_report_frequency_is_two_numbers(self, desk: Desk) -> None:
        assert desk.robot_state.handle(1002, '{"interval": 3, "duration": 30}') == (0, "")
        assert desk.robot_state.handle(1002, '{"interval": -1, "duration": 30}') == (3204, "")


class TestVui:
    @pytest.mark.parametrize(
        ("api_id", "key", "value"), [(1001, "enable", 0), (1003, "volume", 3), (1005, "brightness", 7)]
    )
    def test_a_setting_is_read_back(self, api_id: int, key: str, value: int) -> None:
        vui = Vui()
        assert vui.handle(api_id, json.dumps({key: value})) == (0, "")
        code, data = vui.handle(api_id + 1, "{}")
        assert (code, json.loads(data)) == (0, {key: value})

    @pytest.mark.parametrize("parameter", ["", '{"volume": 11}', '{"volume": 1.5}', '{"volume": -1}'])
    def test_an_invalid_setting_is_a_parameter_error(self, parameter: str) -> None:
        assert Vui().handle(1003, parameter) == (3204, "")
        assert Vui().handle(9999, parameter) == (3203, "")
