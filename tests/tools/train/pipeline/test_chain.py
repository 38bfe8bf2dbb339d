"""`edge-train`: which steps a command does, in which order, once each; what it says, and what it leaves."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED
from edge.inference.latency_profile import LatencyProfile
from export.checkpoint.load import shipped_weights
from export.model.config import PRESETS, with_overrides
from export.model.network import build
from export.model.weights import CheckpointError, WeightsInfo, save_weights
from sim_hil.benchmark.conditions.conditions import Conditions, PolicySpec
from tools.train import cli
from tools.train.config.checks import TrainError
from tools.train.config.collect import DaggerConfig
from tools.train.config.recipe import Recipe, load_recipe
from tools.train.imitate.data import Delays
from tools.train.pipeline import chain
from tools.train.pipeline.chain import Step, adopt, is_done, may_begin, run_step, steps_of, steps_until, take_start
from tools.train.pipeline.model_card import card, ship, write_card
from tools.train.run.job import StageFailedError, StageJob
from tools.train.run.network_file import (
    ExportError,
    export_artifacts,
    finish_network,
    import_start,
    read_network,
    start_network,
)
from tools.train.run.run_dir import RunDir

TINY = load_recipe("tiny")
SCORE = {
    "episodes": 85, "sr": 61.2, "sr_ci95": [50.0, 71.0], "spl": 55.0, "spl_ci95": [45.0, 64.0], "cr": 12.9,
    "cr_ci95": [6.0, 21.0], "ne_m": 6.1, "ne_m_ci95": None,
}  # fmt: skip


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.open(tmp_path / "run", TINY)


def job(run_dir: RunDir, **changed: Any) -> StageJob:
    return StageJob(recipe=TINY, run_dir=run_dir, **changed)


def stage_that(leaves: str) -> Callable[[str], Callable[[StageJob], dict[str, Any]]]:
    """Stages that write a file and say their name."""

    def stage(name: str) -> Callable[[StageJob], dict[str, Any]]:
        def run(given: StageJob) -> dict[str, Any]:
            (given.run_dir.stage(name) / leaves).touch()
            return {"stage": name, "resumed": given.resume}

        return run

    return stage


def use(monkeypatch: pytest.MonkeyPatch, stage: Callable[[str], Callable[[StageJob], dict[str, Any]]]) -> None:
    """Replace all stages."""
    for name in chain.RUNS:
        monkeypatch.setitem(chain.RUNS, name, stage(name))


# The chain


def test_all_goes_through_every_stage_with_imitation_again_after_each_round() -> None:
    recipe = replace(TINY, dagger=DaggerConfig(rounds=2, episodes=1))
    assert [step.name for step in steps_of("all", recipe)] == [
        "collect", "encoder", "sft", "imitate",
        "dagger-1", "sft-1", "imitate-1", "dagger-2", "imitate-2", "rl", "evaluate",
    ]  # fmt: skip
    silent = replace(TINY, dagger=DaggerConfig(rounds=2, episodes=1, sft_rounds=0))
    assert [step.name for step in steps_of("dagger", silent)] == ["dagger-1", "imitate-1", "dagger-2", "imitate-2"]
    assert [step.name for step in steps_of("sft", recipe)] == ["sft"]


def test_a_stage_that_was_begun_is_neither_overwritten_nor_skipped(run_dir: RunDir) -> None:
    (run_dir.stage("sft") / "checkpoint").touch()
    with pytest.raises(TrainError, match="--resume"):
        may_begin(run_dir, Step("sft"), resume=False)
    may_begin(run_dir, Step("sft"), resume=True)


def test_imitation_after_a_round_begins_anew_and_keeps_what_was_before(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, stage_that("before"))
    run_step(job(run_dir), Step("imitate"))
    again = Step("imitate", 1)
    assert is_done(run_dir, Step("imitate")) and not is_done(run_dir, again)
    may_begin(run_dir, again, resume=False)
    use(monkeypatch, stage_that("after"))
    run_step(job(run_dir, resume=True), again)
    assert (run_dir.out / "imitate-0" / "before").exists() and (run_dir.out / "imitate" / "after").exists()
    assert run_dir.result("imitate") == {"stage": "imitate", "resumed": False}
    assert is_done(run_dir, Step("imitate")) and is_done(run_dir, again)


@pytest.mark.slow
def test_borrowed_drives_are_not_added_to(run_dir: RunDir, tmp_path: Path) -> None:
    other = RunDir.open(tmp_path / "other", TINY)
    run_dir.finish("collect", {})
    other.borrow(run_dir, ("collect",), TINY)
    with pytest.raises(TrainError, match=r"dagger.rounds=0"):
        may_begin(other, Step("dagger", 1), resume=False)


def test_a_round_needs_a_policy(run_dir: RunDir) -> None:
    with pytest.raises(TrainError, match="run imitate first"):
        run_step(job(run_dir), Step("dagger", 1))


# The network between stages


DEAF = ("action.latency_aware", "action.motion_offset")


@pytest.mark.slow
@pytest.mark.parametrize("to", DEAF)
def test_an_ablation_of_an_input_starts_from_weights_with_that_input(run_dir: RunDir, tmp_path: Path, to: str) -> None:
    save_weights(build(TINY.model, 7), tmp_path / "w.safetensors", WeightsInfo(True, "elsewhere"))
    deaf = replace(TINY, model=with_overrides(TINY.model, {to: "false"}))
    import_start(run_dir.out, deaf.model, [tmp_path / "w.safetensors"], 1)
    begun, theirs = start_network(replace(job(run_dir), recipe=deaf), "imitate"), build(TINY.model, 7)
    assert all(torch.equal(a, b) for a, b in zip(begun.action.parameters(), theirs.action.parameters(), strict=True))
    assert begun.config == deaf.model


def test_an_ablation_of_another_shape_is_refused_as_a_beginning(run_dir: RunDir, tmp_path: Path) -> None:
    save_weights(build(TINY.model, 7), tmp_path / "w.safetensors", WeightsInfo(True, "elsewhere"))
    with pytest.raises(CheckpointError, match=r"action\.layers is"):
        import_start(run_dir.out, with_overrides(TINY.model, {"action.layers": "2"}), [tmp_path / "w.safetensors"], 1)


@pytest.mark.slow
def test_weights_of_another_language_model_are_refused(run_dir: RunDir) -> None:
    path = finish_network(job(run_dir), "sft", build(TINY.model, 5))
    with pytest.raises(TrainError, match="language differs from the recipe's"):
        read_network(path, with_overrides(TINY.model, {"language.layers": "2"}), 9)
    path.write_bytes(b"nothing")
    with pytest.raises(TrainError, match="not weights of edge-train"):
        read_network(path, TINY.model, 9)


NEWEST = replace(TINY, dagger=DaggerConfig(rounds=2, episodes=1, newest_only=True))


def adopted(run_dir: RunDir, tmp_path: Path, after: str) -> list[str]:
    """The names of what is still to be done after adopting somebody's weights there."""
    save_weights(build(TINY.model, 7), tmp_path / "w.safetensors", WeightsInfo(True, "elsewhere"))
    import_start(run_dir.out, TINY.model, [tmp_path / "w.safetensors"], 1)
    adopt(run_dir, steps_until(after, NEWEST, steps_of("all", NEWEST)))
    return [step.name for step in steps_of("all", NEWEST) if not is_done(run_dir, step)]


def test_a_run_goes_on_from_the_weights_that_a_round_left_elsewhere(
    run_dir: RunDir, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert adopted(run_dir, tmp_path, "imitate-1") == ["dagger-2", "imitate-2", "rl", "evaluate"]
    assert (run_dir.retired("sft"), run_dir.retired("imitate")) == (1, 1)
    use(monkeypatch, stage_that("after"))
    run_step(job(run_dir), Step("imitate", 2))
    assert (run_dir.out / "imitate-1" / "model.safetensors").exists() and run_dir.retired("imitate") == 2


@pytest.fixture
def given(tmp_path: Path) -> Path:
    """Weights of somebody."""
    path = tmp_path / "w.safetensors"
    save_weights(build(TINY.model, 7), path, WeightsInfo(True, "elsewhere"))
    return path


AFTER = steps_until("imitate-1", NEWEST, steps_of("all", NEWEST))


def test_given_weights_may_be_named_again_when_a_run_continues(run_dir: RunDir, given: Path) -> None:
    for _ in range(2):
        take_start(run_dir, NEWEST, [given], AFTER)
    assert (run_dir.retired("sft"), run_dir.retired("imitate")) == (1, 1)


def test_an_interrupted_adoption_is_finished(run_dir: RunDir, given: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finish, count = RunDir.finish, 0

    def interrupted(self: RunDir, stage: str, result: Any) -> None:
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt
        finish(self, stage, result)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(RunDir, "finish", interrupted)
        take_start(run_dir, NEWEST, [given], AFTER)
    take_start(run_dir, NEWEST, [given], AFTER)
    done = [step.name for step in steps_of("all", NEWEST) if is_done(run_dir, step)]
    assert done == [step.name for step in AFTER] and run_dir.retired("imitate") == 1


def test_a_run_that_was_started_otherwise_does_not_go_on_without_the_given_weights(
    run_dir: RunDir, given: Path, tmp_path: Path
) -> None:
    others = tmp_path / "others.safetensors"
    save_weights(build(TINY.model, 8), others, WeightsInfo(True, "elsewhere"))
    finish_network(job(run_dir), "imitate", build(TINY.model, 5))
    with pytest.raises(TrainError, match=r"--checkpoint: .* was started without it .it has the stage imitate"):
        take_start(run_dir, NEWEST, [given], ())
    second = RunDir.open(tmp_path / "second", NEWEST)
    take_start(second, NEWEST, [given], AFTER)
    with pytest.raises(TrainError, match="was started with other weights"):
        take_start(second, NEWEST, [others], AFTER)
    with pytest.raises(TrainError, match=r"--after imitate: .* was started with --after imitate-1"):
        take_start(second, NEWEST, [given], steps_until("imitate", NEWEST, steps_of("all", NEWEST)))
    third = RunDir.open(tmp_path / "third", NEWEST)
    take_start(third, NEWEST, [given], ())
    finish_network(replace(job(third)), "imitate", build(TINY.model, 5))
    with pytest.raises(TrainError, match=r"--after imitate-1: .* was started without --after"):
        take_start(third, NEWEST, [given], AFTER)


@pytest.mark.parametrize(
    ("after", "recipe", "message"),
    [("sft", NEWEST, "expected one of imitate, imitate-1"), ("imitate", TINY, "set dagger.newest_only=true")],
)
def test_weights_are_adopted_only_where_all_later_steps_are_possible(after: str, recipe: Recipe, message: str) -> None:
    with pytest.raises(TrainError, match=message):
        steps_until(after, recipe, steps_of("all", recipe))


# Export in between


def command(tmp_path: Path, code: int, message: str = "") -> list[str]:
    """An `edge-export` that writes down what it is asked, and ends."""
    script = tmp_path / "export.sh"
    lines = (
        f'echo "$@" >> {tmp_path}/asked',
        f'echo "{message}"',
        'mkdir -p "${@: -1}"',
        'touch "${@: -1}/manifest.json"',
        f"exit {code}",
    )
    script.write_text("\n".join(lines) + "\n")
    return ["bash", str(script)]


def test_weights_are_exported_once(tmp_path: Path) -> None:
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(b"1")
    for content, times in ((b"1", 1), (b"1", 1), (b"2", 2)):
        weights.write_bytes(content)
        export_artifacts(weights, PRESETS["nano"], tmp_path / "a", command=command(tmp_path, 0))
        asked = (tmp_path / "asked").read_text().splitlines()
        assert len(asked) == times and f"--checkpoint {weights}" in asked[-1] and "--model nano" in asked[-1]


def test_a_failed_export_reports_its_last_line(tmp_path: Path) -> None:
    (tmp_path / "w").write_bytes(b"1")
    with pytest.raises(ExportError, match="ended with 1: cosine too low"):
        export_artifacts(
            tmp_path / "w", PRESETS["nano"], tmp_path / "a", command=command(tmp_path, 1, "cosine too low")
        )
    with pytest.raises(KeyboardInterrupt):
        export_artifacts(tmp_path / "w", PRESETS["nano"], tmp_path / "a", command=command(tmp_path, 130))


# The command


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages that do nothing but leave a file."""
    use(monkeypatch, stage_that("file"))


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


@pytest.mark.slow
def test_stages_are_run_one_by_one_into_one_folder(tmp_path: Path, stages: None, capsys: Any) -> None:
    out = tmp_path / "run"
    assert run("collect", "--preset", "tiny", "--out", out, "--json", tmp_path / "r.json") == EXIT_DONE
    assert run("sft", "--out", out) == EXIT_DONE
    assert json.loads((tmp_path / "r.json").read_text())["stages"]["collect"]["stage"] == "collect"
    assert RunDir(out).result("sft") is not None and load_recipe(str(out / "recipe.toml")) == TINY
    assert set(RunDir(out).timings()) == {"collect", "sft"}
    assert run("sft", "--out", out) == EXIT_DONE
    assert "sft: done before" in capsys.readouterr().err


def test_a_dry_run_after_given_weights_leaves_out_what_they_replace(tmp_path: Path, capsys: Any) -> None:
    weights = ("--checkpoint", "w.safetensors", "--after", "imitate", "--set", "dagger.newest_only=true")
    assert run("all", "--preset", "tiny", "--out", tmp_path / "run", *weights, "--dry-run", "--json", "-") == EXIT_DONE
    budget = json.loads(capsys.readouterr().out)["budget"]
    assert budget[0]["step"] == "dagger-1"


def test_a_dry_run_prints_the_steps_and_writes_nothing(tmp_path: Path, capsys: Any) -> None:
    assert run("all", "--preset", "tiny", "--out", tmp_path / "run", "--dry-run", "--json", "-") == EXIT_DONE
    printed = capsys.readouterr()
    assert "dagger-1" in printed.err and "  total " in printed.err and not (tmp_path / "run").exists()
    assert json.loads(printed.out)["budget"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sft",), "--out is missing"),
        (("sft", "--preset", "nono", "--out", "x"), "expected one of 1b, nano, tiny"),
        (("sft", "--recipe", "nano", "--out", "x"), "ends in .toml"),
        (("sft", "--recipe", "nowhere.toml", "--out", "x"), "cannot be read"),
        (("sft", "--preset", "tiny", "--device", "tpu", "--out", "x"), "expected cpu, cuda or cuda:N"),
        (("sft", "--preset", "tiny", "--set", "sft.epoch=1", "--out", "x"), "did you mean epochs"),
        (("sft", "--preset", "tiny", "--scores", "f.json", "--out", "x"), "belong to card"),
        (("imitate", "--preset", "tiny", "--delay-profile", "no.json", "--out", "x"), "cannot be read"),
        (("imitate", "--preset", "tiny", "--after", "imitate", "--out", "x"), "expected --checkpoint with it"),
        (("card", "--out", "x"), "the folder of a run"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == EXIT_BAD_INPUT
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_keeps_its_own_copy_of_a_devices_delays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    profile, out = tmp_path / "orin.json", tmp_path / "out"
    use(monkeypatch, stage_that("weights"))
    asked = ("imitate", "--preset", "tiny", "--out", out, "--delay-profile", profile)
    profile.write_text(json.dumps(LatencyProfile.constant(2.0).as_json()))
    assert run(*asked) == EXIT_DONE
    profile.write_text(json.dumps(LatencyProfile.constant(5.0).as_json()))
    imitation = load_recipe(str(out / "recipe.toml")).imitate
    assert imitation is not None and Delays.of(imitation.delays).mean_s == pytest.approx(3.0, abs=0.1)
    assert run(*asked, "--resume") == EXIT_BAD_INPUT
    assert "started with another recipe (imitate.delays.profile" in capsys.readouterr().err


def raising(error: BaseException) -> Callable[[str], Callable[[StageJob], dict[str, Any]]]:
    def stage(_name: str) -> Callable[[StageJob], dict[str, Any]]:
        def fail(_job: StageJob) -> dict[str, Any]:
            raise error

        return fail

    return stage


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), EXIT_INTERRUPTED),
        (ExportError("a gate failed"), EXIT_CHECK_FAILED),
        (StageFailedError("its process ended"), EXIT_CHECK_FAILED),
        (StageFailedError("its process ended"), EXIT_CHECK_FAILED),
        (TrainError("no such drive"), EXIT_BAD_INPUT),
        (OSError("the disk is full"), EXIT_BAD_INPUT),
    ],
)
def test_a_stage_that_cannot_go_on_ends_with_its_code_and_a_line(
    error: BaseException, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    use(monkeypatch, raising(error))
    assert run("sft", "--preset", "tiny", "--out", tmp_path / "run") == code
    assert "Traceback" not in capsys.readouterr().err and RunDir(tmp_path / "run").result("sft") is None


def test_a_bug_is_not_reported_as_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, raising(ValueError("shapes do not match")))
    with pytest.raises(ValueError, match="shapes"):
        run("sft", "--preset", "tiny", "--out", tmp_path / "run")


def test_torchrun_is_for_stages_that_share_batches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    from contextlib import nullcontext

    from tools.train.run.distributed import Ranks

    monkeypatch.setattr(cli, "ranks_of_environment", lambda _device: nullcontext(Ranks(0, 2)))
    assert run("collect", "--preset", "tiny", "--out", tmp_path / "run") == EXIT_BAD_INPUT
    assert "torchrun is for encoder, sft, imitate" in capsys.readouterr().err


# Model card, and what is given away


@pytest.fixture
def trained(run_dir: RunDir) -> RunDir:
    finish_network(job(run_dir), "imitate", build(TINY.model, 1))
    run_dir.finish("imitate", {"loss": 0.25, "steps": 10})
    run_dir.finish("collect", {"drives": 8, "sha256": "ab12"})
    run_dir.finish("evaluate", {"latency_s": 2.0, "summary": {**SCORE, "episodes": 60}})
    return run_dir


def test_the_card_names_its_data_and_its_scores(trained: RunDir, tmp_path: Path) -> None:
    scores = tmp_path / "result.json"
    conditions = Conditions(
        PolicySpec.parse("artifacts:out/nano"), mode="async", latency=LatencyProfile.constant(2.0), wordings="training"
    )
    latency = {"profile": "2 s", "delay_s": {"mean": 3.1}}
    content = {"suite": "dynanav", "conditions": conditions.as_json(), "latency": latency, "trained": True}
    scores.write_text(json.dumps({**content, "summary": {**SCORE, "finished": True}}))
    text = write_card(trained, TINY, [scores]).read_text()
    for part in (
        "SHA-256", "| language model |", "lockstep, async, latency 2 s, training wordings", "mean Δt 3.10 s",
        "61.2 (50.0 to 71.0)", "| 60 |",
        "* sha256: ab12", "* loss: 0.25", f"Seed {TINY.seed}", "## Limits", "Apache-2.0", "torch 2.",
    ):  # fmt: skip
        assert part in text
    assert card(trained, TINY, trained.model_path) == card(trained, TINY, trained.model_path)


def test_scores_of_an_unfinished_run_are_refused(trained: RunDir, tmp_path: Path) -> None:
    conditions = Conditions(PolicySpec("still")).as_json()
    content = {"suite": "dynanav", "conditions": conditions, "latency": {}, "trained": True}
    (tmp_path / "r.json").write_text(json.dumps({**content, "summary": {**SCORE, "finished": False}}))
    with pytest.raises(TrainError, match="expected a finished run"):
        write_card(trained, TINY, [tmp_path / "r.json"])


def test_a_file_that_is_no_benchmark_result_is_refused(trained: RunDir, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(TrainError, match=r"result.json of edge-bench"):
        write_card(trained, TINY, [tmp_path / "other.json"])


def test_weights_that_are_given_away_are_half_the_size_and_the_default_of_their_network(
    trained: RunDir, tmp_path: Path
) -> None:
    path = ship(trained, TINY, tmp_path / "weights")
    assert path.stat().st_size < 0.55 * trained.model_path.stat().st_size
    assert shipped_weights(TINY.model, tmp_path / "weights") == path and path.with_suffix(".md").is_file()
    assert shipped_weights(with_overrides(TINY.model, {"action.layers": "2"}), tmp_path / "weights") is None
    assert shipped_weights(TINY.model, tmp_path / "nothing") is None


@pytest.mark.slow
@pytest.mark.parametrize("text", [None, b"# Somebody's weights", b"\xff\xfe"])
def test_weights_without_a_card_are_foreign(run_dir: RunDir, tmp_path: Path, text: bytes | None) -> None:
    if text is not None:
        (tmp_path / "w.md").write_bytes(text)
    adopted(run_dir, tmp_path, "imitate")
    assert "weights of others" in card(run_dir, NEWEST, run_dir.model_path)


def test_without_weights_there_is_no_card(run_dir: RunDir) -> None:
    with pytest.raises(TrainError, match="train first"):
        write_card(run_dir, TINY)
