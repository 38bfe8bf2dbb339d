"""Plans are to keep off walls that no policy is told of: as far as the expert's own plan does, and no further."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.train_drives import MadeUpTokens, tiny_model
from tests.train_imitate_rank import CONFIG, SideStates, imitate_job, side_dataset, side_drive, trained
from tools.train.action_batch import Group, collate
from tools.train.delays import DelayConfig, Delays
from tools.train.drive import Drive
from tools.train.drive_frames import DriveFrames
from tools.train.imitation_data import SampleConfig, Samples
from tools.train.imitation_pupils import LossConfig
from tools.train.mirror_drives import mirrored_drive
from tools.train.sites import Site
from tools.train.walls import OPEN_M, SHAPE, Scenes, Walls, nothing_near, room, too_near

SCENES = Scenes()
GRID = Site("corridor", 100).robot_grid("go2")
CPU = torch.device("cpu")


def moved(drive: Drive) -> Drive:
    return dataclasses.replace(drive, pose=drive.pose + np.array((5.0, 0.0, 0.3)))


@pytest.fixture(scope="module")
def walls() -> Walls:
    """Along a drive down the demo's corridor, whose walls are about 1.5 m to either side."""
    drive = side_drive("left-a", kind="corridor")
    found = SCENES.along(moved(drive))
    assert found is not None
    return found


def straight(heading: float, metres: float = 3.0) -> torch.Tensor:
    """[1, 30, 3]: away from here in one direction."""
    gone = torch.linspace(metres / 30, metres, 30)
    angle = torch.tensor(heading)
    return torch.stack([gone * torch.cos(angle), gone * torch.sin(angle), angle.expand(30)], dim=1)[None]


def around(walls: Walls, k: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    body = torch.tensor([[walls.body.reach_m, walls.body.radius_m]])
    return torch.from_numpy(walls.patches([k])).float(), body


KNOWN = torch.ones(1, 30, dtype=torch.bool)


@given(k=st.integers(0, 129), heading=st.floats(-1.2, 1.2), metres=st.floats(0.1, 3.0))
def test_room_is_what_the_scene_leaves_before_and_behind_the_robot(
    walls: Walls, k: int, heading: float, metres: float
) -> None:
    plan = straight(heading, metres)
    found = room(plan, *around(walls, k))[0].numpy()
    x, y, turn = walls.pose[k]
    xy = plan[0, :, :2].numpy() @ np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))]) + (x, y)
    reach = walls.body.reach_m * np.array((np.cos(turn + heading), np.sin(turn + heading)))
    gaps = np.minimum(GRID.clearances_at(xy + reach), GRID.clearances_at(xy - reach))
    # Beyond the floor the grid says -1, and between cells of either grid clearances are blended.
    on_floor = gaps > 0
    np.testing.assert_allclose(found[on_floor], gaps[on_floor] - walls.body.radius_m, atol=0.08)
    assert (found[~on_floor] < 0.1 - walls.body.radius_m).all()


def test_the_walls_of_a_mirrored_drive_are_on_the_other_side(walls: Walls) -> None:
    drive = side_drive("left-a", kind="corridor")
    other = SCENES.along(mirrored_drive(moved(drive)), in_mirror=True)
    assert other is not None
    np.testing.assert_allclose(other.patches([0, 90]), walls.patches([0, 90])[:, ::-1], atol=2e-3)


def test_a_plan_into_a_wall_is_pushed_out_of_it(walls: Walls) -> None:
    label, plan = straight(-0.3), straight(0.8).requires_grad_()
    cost = too_near(plan, label, KNOWN, *around(walls), 0.2)
    cost.sum().backward()
    assert cost.item() > 0 and plan.grad is not None
    before = room(plan.detach(), *around(walls))
    after = room(plan.detach() - 1.0 * plan.grad.sign() * (plan.grad.abs() > 1e-6) * 0.1, *around(walls))
    assert after.min() > before.min()


@given(heading=st.floats(-1.2, 1.2), metres=st.floats(0.1, 3.0))
def test_what_the_expert_does_costs_nothing(walls: Walls, heading: float, metres: float) -> None:
    plan = straight(heading, metres)
    assert too_near(plan, plan, KNOWN, *around(walls), 0.2).item() == 0


def test_a_plan_with_room_enough_costs_nothing(walls: Walls) -> None:
    along = -0.3  # the corridor's own direction
    assert room(straight(along), *around(walls)).min() > 0.2
    assert too_near(straight(along), straight(0.0, 0.2), KNOWN, *around(walls), 0.2).item() == 0


def test_steps_whose_label_is_not_known_cost_nothing(walls: Walls) -> None:
    known = KNOWN.clone()
    known[:, 5:] = False
    plan = straight(0.8)
    assert too_near(plan, straight(-0.3), KNOWN, *around(walls), 0.2) > 0
    assert too_near(plan, straight(-0.3), known, *around(walls), 0.2) == 0


def test_nothing_is_near_where_the_scene_is_not_ours() -> None:
    assert SCENES.along(side_drive("left-a", kind="imported")) is None
    patches = torch.from_numpy(nothing_near(1)).float()
    assert room(straight(0.8), patches, torch.zeros(1, 2)).unique().item() == OPEN_M


def drawn(frames: DriveFrames, tmp_path: Path) -> Group:
    plain = SampleConfig().undisturbed()
    states = SideStates(side_dataset(tmp_path))
    every = Delays.uniform(DelayConfig())
    samples = Samples([frames], MadeUpTokens(), states, every, plain, tiny_model(), drop=False)
    return samples.draw(np.random.default_rng(1))


def test_samples_carry_walls_where_these_are_looked_at(tmp_path: Path) -> None:
    drive = side_drive("left-a", kind="corridor")
    weights = SampleConfig().weights
    without = drawn(DriveFrames.of(drive, 30, weights), tmp_path / "a")
    given_ = drawn(DriveFrames.of(drive, 30, weights, SCENES.along(drive)), tmp_path / "b")
    assert without.around is None and given_.around is not None
    assert given_.around.patches.shape == (4, *SHAPE)
    with pytest.raises(ValueError, match="around all groups"):
        collate([without, given_], CPU)


def test_walls_are_added_to_equation_4(tmp_path: Path, walls: Walls) -> None:
    drive = side_drive("left-a", kind="corridor")
    batch = collate([drawn(DriveFrames.of(drive, 30, SampleConfig().weights, walls), tmp_path)], CPU)
    plan = straight(1.2).expand(len(batch), -1, -1)
    plain, more = LossConfig(), LossConfig(walls=3.0, room_m=0.1)
    assert batch.around is not None
    near = too_near(plan, batch.target, batch.known, *batch.around, 0.1)
    assert near.max() > 0
    torch.testing.assert_close(more.of(plan, batch), plain.of(plan, batch) + 3.0 * near)


def test_imitation_tells_how_often_plans_lead_into_walls(tmp_path: Path) -> None:
    dataset = side_dataset(tmp_path / "collect")
    _, plain = trained(dataset, imitate_job(tmp_path / "plain"))
    config = dataclasses.replace(CONFIG, loss=LossConfig(walls=3.0))
    _, result = trained(dataset, imitate_job(tmp_path / "walls", config))
    assert "into_walls" not in plain["held_out"]
    assert set(result["held_out"]["into_walls"]) == {"policy", "other_words"}
    assert result["loss"] != plain["loss"]
