"""What a run may be asked for, and that it means the same wherever it is read."""

from __future__ import annotations

from typing import Any

import pytest

from edge.state.switches import Decoding, RecoverySwitch, Speculation, Switches
from sim_hil.benchmark.arguments import conditions_of, parser
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile


def asked(*arguments: str) -> Conditions:
    return conditions_of(parser().parse_args(["--suite", "s", *arguments]))


@pytest.mark.parametrize(
    "arguments",
    [
        ("--policy", "expert", "--drift", "severe"),
        ("--policy", "artifacts:nano", "--mode", "sync", "--latency", "3", "--variant", "no-latency"),
        ("--policy", "artifacts:nano", "--stay"),
        ("--policy", "artifacts:nano", "--decoding", "free", "--recovery", "off"),
        ("--policy", "external:127.0.0.1:7001", "--latency", "1.5", "--wording", "2"),
        ("--policy", "external:unix:server.sock", "--camera", "320x180"),
    ],
)
def test_conditions_survive_json(arguments: tuple[str, ...]) -> None:
    conditions = asked(*arguments)
    assert Conditions.of_json(conditions.as_json()) == conditions


def test_the_robot_halts_at_its_own_stop_only_on_request() -> None:
    free, stays = asked("--policy", "artifacts:nano"), asked("--policy", "artifacts:nano", "--stay")
    assert not free.stays and "halts" not in free.describe()
    assert stays.stays and "halts at its own stop" in stays.describe()


def test_a_switch_without_an_option_is_the_manifests() -> None:
    free = asked("--policy", "artifacts:nano", "--decoding", "free")
    resolved = free.with_defaults_of(Switches(Decoding.CONSTRAINED, RecoverySwitch.OFF, False, Speculation.OFF))
    assert (resolved.decoding, resolved.recovery, resolved.speculation) == ("free", "off", "off")
    assert "decoding free, recovery off" in resolved.describe()


def test_conditions_of_an_older_version_can_still_be_read() -> None:
    content = asked("--policy", "artifacts:nano").as_json()
    added = ("decoding", "recovery", "speculation", "wordings", "swap_instructions", "turn_starts")
    old = {key: value for key, value in content.items() if key not in added}
    assert Conditions.of_json(old) == asked("--policy", "artifacts:nano")


def test_an_artifact_directory_means_the_same_in_a_worker_elsewhere() -> None:
    assert asked("--policy", "artifacts:nano").policy.where.startswith("/")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--policy", "clever"), "expected artifacts:DIR, external:ADDR"),
        (("--policy", "artifacts:"), "expected artifacts:DIR"),
        (("--policy", "expert:here"), "expected artifacts:DIR"),
        (("--policy", "expert", "--mode", "sync"), "mode: expected one for artifacts:DIR and for no other policy"),
        (
            ("--policy", "expert", "--latency", "2"),
            "latency: expected only with artifacts:DIR or external:ADDR, found with expert",
        ),
        (("--policy", "random", "--variant", "full"), "with --policy artifacts:DIR"),
        (("--policy", "expert", "--stay"), "stay: expected only with artifacts:DIR"),
        (("--policy", "expert", "--decoding", "free"), "decoding: expected only with artifacts:DIR"),
        (("--policy", "still", "--recovery", "off"), "recovery: expected only with artifacts:DIR"),
        (("--policy", "artifacts:nano", "--recovery", "off", "--stay"), "expected --recovery on with it, found off"),
        (("--policy", "artifacts:nano", "--variant", "../up"), "variant '../up'"),
        (("--policy", "still", "--camera", "big"), "expected auto or WxH"),
        (("--policy", "still", "--camera", "8x8"), "expected auto or WxH"),
        (("--policy", "still", "--wording", "-1"), "wording"),
        (("--policy", "external:h:1", "--external-timeout", "0"), "external timeout"),
    ],
)
def test_contradictory_conditions_are_refused_in_one_line(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConditionsError, match=message) as caught:
        asked(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [{"clock": "lockstep", "more": 1}, {"drift": "mild"}, {"policy": 7}])
def test_conditions_of_another_kind_are_refused(change: dict[str, Any]) -> None:
    content = {**Conditions(PolicySpec("still")).as_json(), **change}
    with pytest.raises(ConditionsError):
        Conditions.of_json(content)


def test_a_model_needs_a_latency_in_lockstep() -> None:
    with pytest.raises(ConditionsError, match="expected one for artifacts:DIR in lockstep"):
        Conditions(PolicySpec("artifacts", "/nano"), mode="async")
    Conditions(PolicySpec("artifacts", "/nano"), mode="async", latency=LatencyProfile.constant(1))
