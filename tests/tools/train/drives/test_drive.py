"""A drive is one file that gives back what was recorded; a data set is split by layout and known by its hash."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from tests.support.train.train_drives import about, dataset, drive
from tools.train.config.checks import TrainError
from tools.train.drives.dataset import LINES, DatasetWriter
from tools.train.drives.drive import INDEX, Dataset, Drive, Entry

# -- one file a drive -------------------------------------------------------------------------------------------------


def test_a_drive_reads_back_as_it_was_recorded(tmp_path: Path) -> None:
    made = drive(frames=40)
    made.save(tmp_path / "a.safetensors")
    found = Drive.load(tmp_path / "a.safetensors")
    assert found.about == made.about
    for name in ("jpeg", "jpeg_end", "pose", "pose_odom", "state", "future", "future_steps", "plan_xy", "by"):
        assert np.array_equal(getattr(found, name), getattr(made, name)), name


def test_a_picture_comes_back_upright_and_in_its_colours() -> None:
    picture = drive(frames=30).frame(20)
    assert picture.shape == (128, 128, 3) and picture.dtype == np.uint8
    assert np.allclose(picture[10:50, :].mean(axis=(0, 1)), (80, 0, 0), atol=4)
    assert np.allclose(picture[80:120, :].mean(axis=(0, 1)), (0, 0, 200), atol=4)


def test_without_its_pictures_everything_else_is_there(tmp_path: Path) -> None:
    drive().save(tmp_path / "a")
    found = Drive.load(tmp_path / "a", pictures=False)
    assert len(found) == 60 and found.T_odom_base(0).as_tuple() == (0.0, 0.0, 0.0)
    with pytest.raises(TrainError, match="without its images"):
        found.frame(0)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("pose", np.zeros((59, 3)), "pose: expected"),
        ("state", np.zeros((60, 3)), "state: expected float32"),
        ("pose_odom", np.full((60, 3), np.nan), "not finite"),
        ("jpeg_end", np.zeros(60, np.int64), "increasing"),
        ("future_steps", np.full(60, 51, np.int16), "0 to 50"),
    ],
)
def test_arrays_that_cannot_be_are_refused(name: str, value: np.ndarray, message: str) -> None:
    with pytest.raises(TrainError, match=message):
        replace(drive(), **{name: value})


def test_traces_must_be_a_second_apart() -> None:
    with pytest.raises(TrainError, match="every 10 frames"):
        about(traces=({"k": 0}, {"k": 11}))


@pytest.mark.parametrize("name", ["../a", "", "a/b", ".a"])
def test_an_id_is_no_path(name: str) -> None:
    with pytest.raises(TrainError, match="expected an id of"):
        about(name)


def test_a_header_with_a_key_too_many_is_refused(tmp_path: Path) -> None:
    drive().save(tmp_path / "a")
    arrays = load_file(tmp_path / "a")
    save_file(arrays, tmp_path / "b", metadata={"drive": json.dumps({"format": 1, "more": 2})})
    with pytest.raises(TrainError, match="keys in its header"):
        Drive.load(tmp_path / "b")
    save_file(arrays, tmp_path / "c")
    with pytest.raises(TrainError, match="header is not a drive"):
        Drive.load(tmp_path / "c")


def test_a_torn_file_is_one_clear_line(tmp_path: Path) -> None:
    drive().save(tmp_path / "a")
    (tmp_path / "b").write_bytes((tmp_path / "a").read_bytes()[:-100])
    with pytest.raises(TrainError, match="not a readable drive"):
        Drive.load(tmp_path / "b")


# -- data sets --------------------------------------------------------------------------------------------------------


def test_the_split_is_by_layout_and_every_drive_is_in_one_half() -> None:
    seeds = range(100, 400)
    halves = {seed: {about(f"a{i}", layout_seed=seed, seed=i).is_val for i in range(3)} for seed in seeds}
    assert all(len(half) == 1 for half in halves.values())
    share = sum(half == {True} for half in halves.values()) / len(halves)
    assert 0.08 < share < 0.18


def test_the_demos_corridor_is_never_kept_from_training() -> None:
    assert not any(about(kind="corridor", layout_seed=seed).is_val for seed in range(100, 200))


def test_the_order_in_which_drives_came_changes_neither_index_nor_hash(tmp_path: Path) -> None:
    drives = [drive(f"e{i}", frames=20) for i in range(3)]
    one, other = dataset(tmp_path / "one", *drives), dataset(tmp_path / "other", *drives[::-1])
    assert one.sha256 == other.sha256
    assert (tmp_path / "one" / INDEX).read_bytes() == (tmp_path / "other" / INDEX).read_bytes()


def test_verifying_finds_one_wrong_byte(tmp_path: Path) -> None:
    found = dataset(tmp_path, drive("e0", frames=20))
    Dataset.open(tmp_path, verify=True)
    data = bytearray(found.path("e0").read_bytes())
    data[-1] ^= 1
    found.path("e0").write_bytes(data)
    Dataset.open(tmp_path)
    with pytest.raises(TrainError, match="differs from the indexed file"):
        Dataset.open(tmp_path, verify=True)


def test_a_folder_that_is_no_data_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainError, match="record one with collect"):
        Dataset.open(tmp_path)


# -- writing them -----------------------------------------------------------------------------------------------------


def test_a_writer_continues_an_existing_data_set(tmp_path: Path) -> None:
    dataset(tmp_path, drive("e0", frames=20))
    with DatasetWriter(tmp_path) as writer:
        assert writer.has("e0") and not writer.has("e1")
        writer.drop("e1", "it fell")
    with DatasetWriter(tmp_path) as writer:
        assert writer.has("e1")
        assert writer.summary()["drives"] == 1 and writer.summary()["dropped"] == {"it fell": 1}


def test_a_drive_whose_file_has_changed_is_forgotten(tmp_path: Path) -> None:
    found = dataset(tmp_path, drive("e0", frames=20), drive("e1", frames=20))
    found.path("e0").write_bytes(b"something else")
    found.path("e1").unlink()
    with DatasetWriter(tmp_path) as writer:
        assert not writer.has("e0") and not writer.has("e1")


def test_a_torn_last_line_costs_that_drive_only(tmp_path: Path) -> None:
    dataset(tmp_path, drive("e0", frames=20), drive("e1", frames=20))
    lines = (tmp_path / LINES).read_text()
    (tmp_path / LINES).write_text(lines[: len(lines) - 30])
    with DatasetWriter(tmp_path) as writer:
        assert writer.has("e0") and not writer.has("e1")
        writer.add(Entry.of(drive("e1", frames=20), writer.path("e1")))
    with DatasetWriter(tmp_path) as writer:
        assert writer.has("e1")


def test_two_writers_at_a_time_are_refused(tmp_path: Path) -> None:
    with DatasetWriter(tmp_path), pytest.raises(TrainError, match="another process"):
        DatasetWriter(tmp_path)
    DatasetWriter(tmp_path).close()


def test_half_a_file_of_a_killed_writer_is_swept_away(tmp_path: Path) -> None:
    dataset(tmp_path, drive("e0", frames=20))
    (tmp_path / "drives" / "e1.safetensors.77.partial").write_bytes(b"half")
    DatasetWriter(tmp_path).close()
    assert [path.name for path in (tmp_path / "drives").iterdir()] == ["e0.safetensors"]
