"""A run that learns from drives recorded elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.train.train_drives import dataset, drive
from tools.train import cli
from tools.train.config.checks import TrainError
from tools.train.config.recipe import load_recipe
from tools.train.drives.drive import Dataset
from tools.train.pipeline.model_card import card
from tools.train.run import run_dir as run_dirs
from tools.train.run.network_file import START, import_start
from tools.train.run.run_dir import RunDir, take_drives

TINY = load_recipe("tiny")


@pytest.fixture
def theirs(tmp_path: Path) -> Dataset:
    return dataset(tmp_path / "theirs", drive("a"), drive("b"))


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.open(tmp_path / "run", TINY)


def test_their_drives_are_the_runs_and_nothing_is_collected(run_dir: RunDir, theirs: Dataset) -> None:
    take_drives(run_dir, theirs.folder)
    assert Dataset.open(run_dir.out / "collect", verify=True).sha256 == theirs.sha256
    assert run_dir.result("collect") is not None


def test_their_folder_stays_as_it_is(run_dir: RunDir, theirs: Dataset) -> None:
    before = {path: path.read_bytes() for path in theirs.folder.rglob("*") if path.is_file()}
    take_drives(run_dir, theirs.folder)
    drive("a", 80).save(Dataset.open(run_dir.out / "collect").path("a"))
    assert {path: path.read_bytes() for path in theirs.folder.rglob("*") if path.is_file()} == before


def test_a_run_that_has_collected_takes_no_others(run_dir: RunDir, theirs: Dataset) -> None:
    (run_dir.stage("collect") / "index.jsonl").write_text("")
    with pytest.raises(TrainError, match="has other drives"):
        take_drives(run_dir, theirs.folder)


def test_an_interrupted_call_leaves_no_drives_and_can_be_repeated(
    run_dir: RunDir, theirs: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(source: Path, target: Path) -> None:
        if source.stem == "b":
            raise KeyboardInterrupt
        run_dirs.shutil.copyfile(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(run_dirs, "_link_or_copy", interrupted)
        with pytest.raises(KeyboardInterrupt):
            take_drives(run_dir, theirs.folder)
    assert not run_dir.begun("collect")
    take_drives(run_dir, theirs.folder)
    assert Dataset.open(run_dir.out / "collect", verify=True).ids == ("a", "b")


def test_links_among_their_files_are_followed(run_dir: RunDir, theirs: Dataset) -> None:
    path = theirs.path("a")
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")
    take_drives(run_dir, theirs.folder)
    assert len(Dataset.open(run_dir.out / "collect", verify=True)) == 2


def test_a_damaged_drive_is_refused_and_nothing_taken(run_dir: RunDir, theirs: Dataset) -> None:
    theirs.path("b").write_bytes(b"half")
    with pytest.raises(TrainError, match="differs from the indexed file"):
        take_drives(run_dir, theirs.folder)
    assert not run_dir.begun("collect")


@pytest.mark.slow
def test_the_card_does_not_call_them_ours(run_dir: RunDir, theirs: Dataset, tmp_path: Path) -> None:
    from export.model.network import build
    from export.model.weights import WeightsInfo, save_weights

    save_weights(build(TINY.model, 1), tmp_path / "w.safetensors", WeightsInfo(True, "elsewhere"))
    import_start(run_dir.out, TINY.model, [tmp_path / "w.safetensors"], 1)
    take_drives(run_dir, theirs.folder)
    text = card(run_dir, TINY, run_dir.out / START / "model.safetensors")
    assert "recorded elsewhere" in text and "privileged expert" not in text


def test_a_plan_with_their_drives_collects_nothing(theirs: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["all", "--preset", "tiny", "--drives", str(theirs.folder), "--dry-run"]) == 0
    printed = capsys.readouterr().err
    assert "sft" in printed and "collect" not in printed


@pytest.mark.parametrize("before", ["nothing", "an empty folder", "a run"])
@pytest.mark.parametrize("given", ["--drives", "--from", "--checkpoint"])
def test_a_call_whose_given_files_are_refused_leaves_what_it_found(tmp_path: Path, given: str, before: str) -> None:
    out, damaged = tmp_path / "run", tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "dataset.json").write_text("{")
    (damaged / "model.safetensors").write_bytes(b"no weights")
    if before == "an empty folder":
        out.mkdir()
    elif before == "a run":
        RunDir.open(out, TINY)
    if given == "--from":
        RunDir.open(damaged / "run", TINY)  # none of its stages has finished
        damaged /= "run"
    found = sorted(tmp_path.rglob("*"))
    assert cli.main(["sft", "--preset", "tiny", given, str(damaged), "--out", str(out)]) == 2
    assert sorted(tmp_path.rglob("*")) == found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sft", "--from", "b"), "both name the drives"),
        (("all", "--checkpoint", "w", "--after", "imitate"), "continues without earlier drives"),
        (("card",), "belongs to stages"),
        (("sft",), "expected a data set with dataset.json"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "c"
    RunDir.open(out, TINY)
    assert cli.main([*arguments, "--drives", str(tmp_path / "a"), "--out", str(out)]) == 2
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1
