"""A drive in the mirror is the drive of another place: everything that has a side has the other one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edge.core.geometry import SE2
from tests.support.train.train_drives import MadeUpTokens, tiny_model
from tests.support.train.train_imitate_rank import CONFIG, SideStates, imitate_job, side_dataset, side_drive
from tools.train.config.imitate import DelayConfig, SampleConfig
from tools.train.drives.drive import Dataset
from tools.train.imitate.data import Delays, Samples, Source
from tools.train.imitate.imitate import run
from tools.train.samples.anchors import anchors_of
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.mirror import MirroredDrives, MirrorTokens, balanced, mirrored, mirrored_drive, mirrored_frames

EVEN = SampleConfig().undisturbed()


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return side_dataset(tmp_path_factory.mktemp("collect"))


def test_its_anchors_are_those_that_fine_tuning_has_learned_from() -> None:
    drive = side_drive("left-a")
    assert anchors_of(mirrored_drive(drive)) == [mirrored(anchor) for anchor in anchors_of(drive)]


def test_motion_and_labels_go_to_the_other_side() -> None:
    drive = side_drive("left-a")
    other, right = mirrored_drive(drive), side_drive("right-a")
    for name in ("pose", "state", "future", "plan_xy"):
        np.testing.assert_allclose(getattr(other, name), getattr(right, name), atol=1e-5, err_msg=name)
    assert other.about.goal_xy == pytest.approx(right.about.goal_xy)
    moved = other.T_odom_base(20).inverse() @ other.T_odom_base(90)
    true = drive.T_odom_base(20).inverse() @ drive.T_odom_base(90)
    assert moved.as_tuple() == pytest.approx(SE2(true.x_m, -true.y_m, -true.theta_rad).as_tuple())


class MirroredSeconds:
    """Tokens of 13 seconds; the first number says which."""

    def frames(self, drive_id: str) -> np.ndarray:
        return np.broadcast_to(np.arange(13, dtype=np.float16)[:, None, None], (13, 4, 32))


@pytest.mark.slow
def test_samples_of_the_mirror_are_as_many_as_asked_for_and_of_whole_seconds(dataset: Dataset) -> None:
    plain = [DriveFrames.of(drive, 30, EVEN.weights) for drive in dataset.drives(dataset.train)]
    reflected = MirroredDrives.of(dataset).drives(dataset.train, pictures=False)
    others = [mirrored_frames(DriveFrames.of(drive, 30, EVEN.weights)) for drive in reflected]
    states = SideStates(dataset)
    samples = Samples(
        balanced(plain, others, 0.3),
        MadeUpTokens(),
        states,
        Delays.uniform(DelayConfig()),
        EVEN,
        tiny_model(),
        mirror=Source(MirrorTokens(MirroredSeconds()), states),
        drop=False,
    )
    count = 0
    for number in range(600):
        rng = np.random.default_rng((1, number))
        chosen = samples.choose(rng)
        group = samples.take(chosen, rng)
        drive = samples.drives[chosen.drive]
        if not drive.in_mirror:
            continue
        count += 1
        true = plain[[each.id for each in plain].index(drive.id)]
        for i, k in enumerate(chosen.ks):
            assert k % 10 == 0 and (group.visual_tokens[i] == k // 10).all()
            np.testing.assert_allclose(group.target[i], true.target[k] * (1.0, -1.0, -1.0), atol=1e-6)
            offset = true.offset(chosen.anchor, k)
            np.testing.assert_allclose(
                group.latency[i], (chosen.ages[i] / 10, offset.x_m, -offset.y_m, -offset.theta_rad), atol=1e-5
            )
    assert count / 600 == pytest.approx(0.3, abs=0.05)


@pytest.mark.slow
def test_a_run_learns_from_the_mirror_if_it_is_told_to(tmp_path: Path) -> None:
    losses = []
    for share in (0.0, 0.5):
        side_dataset(tmp_path / f"{share}" / "collect")
        config = dataclasses.replace(CONFIG, samples=8, mirrored=share)
        losses.append(run(imitate_job(tmp_path / f"{share}", config))["loss"])
        folders = {path.name for path in (tmp_path / f"{share}" / "collect").iterdir() if path.is_dir()}
        assert ("kv-mirrored" in folders) == ("tokens-mirrored" in folders) == bool(share)
    assert losses[0] != losses[1]
