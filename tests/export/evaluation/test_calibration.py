"""Calibration data is named, hashed and never random; what it does not know it says."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from export.evaluation.calibration import (
    CLIP_S,
    CalibrationError,
    CalibrationSet,
    load_calibration,
    read_set,
)
from export.evaluation.calibration_names import SETS, list_calibration_sets
from tools.calibration_frames import WALKS, record


@pytest.fixture(scope="module")
def shipped() -> CalibrationSet:
    return load_calibration("corridor-go2")


def _picture(seed: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def _folder(path: Path, count: int = 21) -> Path:
    path.mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(path / f"{i:03d}.png"), _picture(i))
    return path


def _video(path: Path, seconds: int, fps: float = 4.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (64, 48))
    for i in range(round(seconds * fps)):
        # One grey level a second, so that a frame tells when it was taken.
        writer.write(np.full((48, 64, 3), 5 * int(i / fps), np.uint8))
    writer.release()
    return path


def test_the_shipped_set_has_three_walks_of_twenty_seconds(shipped: CalibrationSet) -> None:
    assert [len(clip.frames) for clip in shipped.clips] == [21, 21, 21]
    for clip in shipped.clips:
        assert clip.frames[-1].stamp_ns - clip.frames[0].stamp_ns == CLIP_S * 1e9
        assert clip.frames[0].image.shape == (180, 320, 3) and clip.frames[0].image.dtype == np.uint8
        assert clip.assumed == ""


@pytest.mark.slow
def test_the_shipped_frames_are_what_the_simulator_shows(shipped: CalibrationSet) -> None:
    walk = WALKS[0]
    for shown, kept in zip(record(walk, duration_s=2.0), shipped.clips[0].frames[:3], strict=True):
        assert shown.stamp_ns == kept.stamp_ns
        assert shown.T_odom_base.x_m == pytest.approx(kept.T_odom_base.x_m, abs=0.1)
        assert np.abs(shown.image.astype(int) - kept.image).mean() < 8  # JPEG, and physics on another machine


def test_an_unknown_name_lists_the_names_there_are() -> None:
    with pytest.raises(CalibrationError, match="'imagenet' is not known; expected one of: corridor-go2, folder:PATH"):
        load_calibration("imagenet")
    assert list_calibration_sets() == ["corridor-go2"]


def edited(name: str, before: bytes, after: bytes) -> Callable[[Path], object]:
    """Replace bytes of one file of a set."""
    return lambda copy: (copy / name).write_bytes((copy / name).read_bytes().replace(before, after, 1))


CHANGES = [edited("vending-03.jpg", b"\xff\xd9", b"\xff\xd9\0"), edited("set.toml", b"down", b"up")]


@pytest.mark.parametrize("change", CHANGES)
def test_the_hash_covers_every_file(shipped: CalibrationSet, tmp_path: Path, change: Callable[[Path], object]) -> None:
    copy = tmp_path / "corridor-go2"
    shutil.copytree(SETS / "corridor-go2", copy)
    assert read_set(copy).sha256 == shipped.sha256
    change(copy)
    assert read_set(copy).sha256 != shipped.sha256


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda copy: (copy / "vending-03.jpg").unlink(), "vending-03.jpg is missing"),
        (lambda copy: (copy / "other.jpg").write_bytes(b""), "files that set.toml does not list: other.jpg"),
        (lambda copy: (copy / "vending-03.jpg").write_bytes(b"not an image"), "vending-03.jpg is not a readable image"),
        (edited("set.toml", b"schema", b"colour = 1\nschema"), "unknown key 'colour'"),
        (edited("set.toml", b"pose = [0.009,", b"pose = [inf,"), "expected a finite number, found inf"),
        (edited("set.toml", b"stamp_s = 3.0", b"stamp_s = 1.5"), "apart, expected about 1 s"),
    ],
)
def test_a_damaged_set_is_refused_in_one_line(tmp_path: Path, change: Callable[[Path], object], line: str) -> None:
    copy = tmp_path / "corridor-go2"
    shutil.copytree(SETS / "corridor-go2", copy)
    change(copy)
    with pytest.raises(CalibrationError, match=line) as error:
        read_set(copy)
    assert "\n" not in str(error.value)


def test_a_folder_of_images_is_a_walk_with_assumed_motion(tmp_path: Path) -> None:
    loaded = load_calibration(f"folder:{_folder(tmp_path / 'mine')}")
    (clip,) = loaded.clips
    assert "0.5 m/s" in clip.assumed and "0.5 m/s" in str(loaded.to_dict()["assumed"])
    assert [frame.T_odom_base.x_m for frame in clip.frames[:3]] == [0.0, 0.5, 1.0]
    assert np.array_equal(clip.frames[2].image, _picture(2)[:, :, ::-1])


def test_the_same_pictures_are_the_same_set_wherever_they_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = _folder(tmp_path / "a" / "mine"), _folder(tmp_path / "b" / "mine")
    monkeypatch.chdir(second)
    found = [load_calibration(f"folder:{path}").to_dict() for path in (first, second, ".", "../mine/")]
    assert found == [found[0]] * 4
    assert found[0]["name"] == "folder:mine"


def test_a_long_folder_gives_at_most_three_walks_from_all_over_it(tmp_path: Path) -> None:
    loaded = load_calibration(f"folder:{_folder(tmp_path / 'mine', 90)}")
    assert [clip.name for clip in loaded.clips] == ["images-0", "images-34", "images-69"]


def test_the_hash_of_a_folder_is_that_of_its_images(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "mine")
    before = load_calibration(f"folder:{folder}").sha256
    (folder / "notes.txt").write_text("not an image")
    assert load_calibration(f"folder:{folder}").sha256 == before
    cv2.imwrite(str(folder / "007.png"), _picture(99))
    assert load_calibration(f"folder:{folder}").sha256 != before


def test_a_video_gives_one_picture_a_second(tmp_path: Path) -> None:
    (clip,) = load_calibration(f"video:{_video(tmp_path / 'walk.avi', 25)}").clips
    assert len(clip.frames) == 21 and "0.5 m/s" in clip.assumed
    levels = [float(frame.image.mean()) for frame in clip.frames]
    assert levels == pytest.approx([5.0 * i for i in range(21)], abs=2.0)


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_an_unreadable_source_is_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    with pytest.raises(CalibrationError, match=r"cannot be read \(No such file"):
        load_calibration(f"{kind}:{tmp_path / 'nothing'}")


@pytest.mark.parametrize("name", ["/dev/zero", "fifo", "folder"])
def test_a_video_that_is_no_regular_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    with pytest.raises(CalibrationError, match=r"cannot be read \(is (a directory|not a regular file)"):
        load_calibration(f"video:{tmp_path / name}")


@pytest.mark.parametrize(("name", "line"), [("empty.avi", "not a readable video"), ("short.avi", "at least 21 are")])
def test_a_video_that_is_broken_or_too_short_is_refused(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / "empty.avi").write_bytes(b"")
    _video(tmp_path / "short.avi", 10)
    with pytest.raises(CalibrationError, match=line):
        load_calibration(f"video:{tmp_path / name}")


@pytest.mark.parametrize("count", [0, 20])
def test_a_folder_with_too_few_images_is_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(CalibrationError, match=f"{count} pictures 1 s apart, at least 21 are needed"):
        load_calibration(f"folder:{_folder(tmp_path / 'mine', count)}")


def test_a_huge_sparse_image_in_a_folder_is_refused_before_it_is_read(tmp_path: Path) -> None:
    for number in range(21):
        (tmp_path / f"{number:02d}.png").touch()
    with (tmp_path / "00.png").open("r+b") as file:
        file.truncate(1 << 42)
    with pytest.raises(CalibrationError, match=r"cannot be read .*is larger than"):
        load_calibration(f"folder:{tmp_path}")


def test_an_unreadable_image_in_a_folder_is_named(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "mine")
    (folder / "005.png").write_bytes(b"\x89PNG")
    with pytest.raises(CalibrationError, match=r"005\.png is not a readable image"):
        load_calibration(f"folder:{folder}")


def _png(width: int, height: int) -> bytes:
    """A PNG of that size in its header, without pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_an_image_larger_than_opencv_accepts_is_named(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "mine")
    (folder / "005.png").write_bytes(_png(100_000, 100_000))
    with pytest.raises(CalibrationError, match=r"005\.png is not a readable image"):
        load_calibration(f"folder:{folder}")
