"""`edge-calib power`: energies put in come out, doubtful ones are refused, and the exporter plans with them."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import numpy as np
import pytest

from calib.power import add_arguments, measured_target, run, stage_ms, target_text
from calib.power_fit import FitError, Phase, fit_energy, non_negative
from calib.power_load import Counts, EnergyLog, Load
from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest, seal
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED
from edge.power.governor.plan import STAGES, power_plan
from edge.power.meters.meter import MeterError, PowerSample
from export.model.config import PRESETS
from export.model.network import build
from export.plan.plan import plan
from export.plan.timing import measured_point
from export.targets.file import for_model, list_targets, load_target, parse_target, with_settings
from tests.support.artifact_directory import write_artifacts

TREES = Path(__file__).parents[1] / "data/sysfs"
SECOND = 1_000_000_000
IDLE_W = 5.0
TRUE_J = {"vision_encoder": 1.5, "action_expert": 0.05, "prefill": 4.0, "decode": 0.2, "semantic_context": 0.04}
MIXTURES: dict[str, dict[str, float]] = {
    "idle": {},
    "vision_encoder": {"vision_encoder": 200},
    "action_expert": {"action_expert": 5000},
    "prefill": {"prefill": 90},
    "decode": {"prefill": 20, "decode": 960},
    "semantic_context": {"semantic_context": 4000},
    "control": {"vision_encoder": 150, "action_expert": 150},
    "control and reasoning": {
        "vision_encoder": 150,
        "action_expert": 150,
        "prefill": 6,
        "decode": 288,
        "semantic_context": 6,
    },
}


def phases(*, noise: float = 0.0, rounds: int = 3, seed: int = 0) -> list[Phase]:
    rng, found = np.random.default_rng(seed), []
    for _ in range(rounds):
        for name, counts in MIXTURES.items():
            energy_j = 20.0 * IDLE_W + sum(TRUE_J[stage] * n for stage, n in counts.items())
            energy_j *= 1 + noise * rng.standard_normal()
            found.append(Phase(name, 20.0, energy_j, counts, check=name.startswith("control")))
    return found


def test_energies_that_were_put_in_come_out() -> None:
    fit = fit_energy(phases())
    assert fit.idle_w == pytest.approx(IDLE_W, rel=1e-6)
    assert fit.stage_j == pytest.approx(TRUE_J, rel=1e-6)
    assert not fit.weak


def test_one_percent_of_noise_leaves_energies_within_their_own_error_bars() -> None:
    fit = fit_energy(phases(noise=0.01, rounds=5))
    for stage in STAGES:
        assert abs(fit.stage_j[stage] - TRUE_J[stage]) <= 4 * fit.error_j[stage]
    assert not fit.weak


RNG = np.random.default_rng(1)


@pytest.mark.parametrize(
    ("ran", "reason"),
    [
        (
            [dataclasses.replace(p, energy_j=200.0 * (1 + 0.05 * RNG.standard_normal())) for p in phases()],
            "of the variation of power",
        ),
        (
            [dataclasses.replace(p, energy_j=p.energy_j * (1.4 if p.check else 1.0)) for p in phases()],
            "a mixture that it was not fitted to",
        ),
        ([phase for phase in phases() if not phase.check], ""),
    ],
    ids=["power does not depend on what runs", "stages draw more together than apart", "no mixture to check with"],
)
def test_a_weak_fit_is_refused(ran: list[Phase], reason: str) -> None:
    assert any(reason in found for found in fit_energy(ran).weak)


def test_a_stage_that_never_ran_is_named() -> None:
    with pytest.raises(FitError, match="run decode"):
        fit_energy([phase for phase in phases() if "decode" not in phase.counts])


def test_no_energy_is_below_zero() -> None:
    design = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    assert non_negative(design, np.array([5.0, 4.0, 3.0])) == pytest.approx([4.0, 0.0])


class Ramp:
    """A meter whose power is known at every instant."""

    source, caveat = "ramp", None

    def read(self, now_ns: int) -> PowerSample:
        return PowerSample(now_ns, 10.0 if now_ns <= SECOND else 30.0)


def read_log(readings: int) -> EnergyLog:
    now = [0]
    log = EnergyLog(Ramp(), clock=lambda: now[0])
    for index in range(readings):
        now[0] = index * SECOND // 20
        log.read_once()
    return log


def test_energy_is_integrated_between_the_two_instants() -> None:
    assert read_log(41).energy_j(SECOND // 2, 3 * SECOND // 2) == pytest.approx(0.5 * 10 + 0.5 * 30)


def test_a_meter_that_loses_readings_of_a_phase_is_an_error_and_not_a_small_energy() -> None:
    log = read_log(10)
    with pytest.raises(MeterError, match="readings cover 22 % of a phase"):
        log.energy_j(0, 2 * SECOND)


def test_a_token_takes_what_a_generation_takes_beyond_its_prompt() -> None:
    assert stage_ms(phases(rounds=1))["decode"] == [pytest.approx(1e3 * (20 - 20 * 20 / 90) / 960)]


def test_an_action_takes_what_a_tick_takes_beyond_its_context() -> None:
    ran = [
        Phase("semantic_context", 2.0, 1.0, {"semantic_context": 1000}),
        Phase("action_expert", 2.0, 1.0, {"action_expert": 400, "semantic_context": 400}),
    ]
    assert stage_ms(ran)["action_expert"] == [pytest.approx(3.0)]


@pytest.mark.slow
def test_a_policy_guided_by_waypoints_makes_its_context_in_every_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    action = dataclasses.replace(PRESETS["nano"].action, layers=2, semantic_interface="waypoints", motion_offset=False)
    network = build(dataclasses.replace(PRESETS["nano"], action=action), 3)
    monkeypatch.setattr("edge.inference.warm_up.check_answers", lambda *_: None)  # these artifacts have no answers
    counts = Counts()
    load = Load(load_artifacts(write_artifacts(network, tmp_path)), counts)
    for name, ran in (("action_expert", (1, 1)), ("semantic_context", (0, 1))):
        before = counts.copy()
        load.phases()[name][0](0.0)
        after = counts.copy()
        assert tuple(after[stage] - before[stage] for stage in ("action_expert", "semantic_context")) == ran


@pytest.mark.parametrize("name", list_targets())
def test_every_target_reads_back_from_what_is_written(name: str) -> None:
    target = load_target(name)
    assert parse_target(tomllib.loads(target_text(target)), name) == target


def test_a_plan_with_the_measured_target_has_the_measured_energies(artifacts_dir: Path, artifacts: Artifacts) -> None:
    manifest = read_manifest(artifacts_dir)
    target = parse_target(manifest["provenance"]["target"], "cpu")
    fit, ran = fit_energy(phases()), phases()
    lengths = {"prompt": 168, "new": 48, **stage_ms(ran)}
    points = [
        measured_point(target, manifest, artifacts, stage, lengths, machine="m", date="d", energy_j=TRUE_J[stage])
        for stage in STAGES
    ]
    text = target_text(measured_target(target, fit, ran, points, "a meter"))
    planned = for_model(parse_target(tomllib.loads(text), "mine"), "nano")
    made = plan(planned, PRESETS["nano"], tokens=48)
    power = power_plan({"plan": made.to_dict(), "provenance": {"target": planned.to_dict()}}, 48)
    assert power.model is not None
    assert power.model.idle_w == pytest.approx(IDLE_W)
    assert (power.model.encode_j, power.model.token_j) == pytest.approx((1.5, 0.2), rel=1e-3)
    assert power.model.tagged == "measured"


def options(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args(list(arguments))


def test_a_device_without_a_meter_is_refused_with_every_meter_that_was_tried(
    artifacts_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(options("--artifacts", str(artifacts_dir)), TREES / "no_meter") == EXIT_REFUSED
    assert "rapl: looked for" in capsys.readouterr().err
    assert run(options("--artifacts", str(artifacts_dir), "--meter", "modelled")) == EXIT_REFUSED
    assert "the plan has no energies" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--seconds", "0"), "--seconds 0: expected 0.2 to 3600"),
        (("--rounds", "1"), "--rounds 1: expected 2 to 100"),
        (("--out", "x.json"), "expected a file name that ends in .toml"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    arguments: tuple[str, str], line: str, artifacts_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(options("--artifacts", str(artifacts_dir), *arguments)) == EXIT_BAD_INPUT
    assert line in capsys.readouterr().err


def test_a_directory_that_is_not_one_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(options("--artifacts", str(tmp_path / "none"))) == EXIT_BAD_INPUT
    assert "not a directory" in capsys.readouterr().err


def test_graphs_that_the_self_test_has_not_proven_are_not_measured(artifacts: Artifacts) -> None:
    with pytest.raises(ArtifactError, match="no known answers for the self-test"):
        Load(dataclasses.replace(artifacts, known_answers=None), Counts())


def with_energies(artifacts_dir: Path, folder: Path) -> Path:
    """The same artifacts with a plan of a machine whose power is known."""
    manifest = read_manifest(artifacts_dir)
    target = with_settings(load_target("cpu", "nano"), ["power.idle_w=10", "power.modes.default.busy_w=30"])
    manifest["plan"] = plan(target, PRESETS["nano"]).to_dict()
    manifest["provenance"] = {**manifest["provenance"], "target": target.to_dict()}
    folder.mkdir()
    for path in artifacts_dir.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / MANIFEST_NAME).write_text(json.dumps(seal(manifest)))
    return folder


@pytest.mark.slow
def test_a_dry_run_fits_the_model_it_is_fed_with_and_is_never_called_measured(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    artifacts, out, found = with_energies(artifacts_dir, tmp_path / "a"), tmp_path / "x.toml", tmp_path / "x.json"
    arguments = ("--meter", "modelled", "--seconds", "0.2", "--rounds", "2", "--out", str(out), "--json", str(found))
    assert run(options("--artifacts", str(artifacts), *arguments)) in (EXIT_DONE, EXIT_CHECK_FAILED)
    result = json.loads(found.read_text())
    assert result["tagged"] == "modelled"
    assert {phase["name"] for phase in result["phases"]} == set(MIXTURES)
    assert result["fit"]["idle_w"] == pytest.approx(10.0, rel=0.3)
    assert not out.exists()
