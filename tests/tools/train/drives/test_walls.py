"""Plans are to keep off walls that no policy is told of: as far as the expert's own plan does, and no further."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.scene.nav_grid import NavGrid
from tests.support.train.train_drives import VAL_LAYOUT, MadeUpTokens, tiny_model, write_dataset
from tests.support.train.train_imitate_rank import CONFIG, SideStates, imitate_job, side_dataset, side_drive, trained
from tools.train.config.imitate import DelayConfig, LossConfig, SampleConfig
from tools.train.drives.drive import Drive
from tools.train.drives.scenarios import Site
from tools.train.drives.walls import OPEN_M, SHAPE, Scenes, Walls, nothing_near, room, too_near
from tools.train.imitate.data import Delays, Samples
from tools.train.imitate.evaluation import plans_into_walls
from tools.train.samples.action_batch import Group, collate
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.mirror import mirrored_drive

SCENES = Scenes()
CPU = torch.device("cpu")


def in_corridor(scene: str = "corridor-100") -> Drive:
    """Down the demo's corridor, whose walls are about 1.5 m to either side; it looks 0.3 rad to the left."""
    drive = side_drive("left-a", kind="corridor", scene=scene)
    return dataclasses.replace(drive, pose=drive.pose * (1.0, 0.3, 1.0) + np.array((5.0, 0.0, 0.3)))


@pytest.fixture(scope="module")
def walls() -> Walls:
    found = SCENES.along(in_corridor())
    assert found is not None
    return found


@pytest.fixture(scope="module")
def grid() -> NavGrid:
    return Site("corridor", 100).robot_grid("go2")


def straight(heading: float, metres: float = 3.0) -> torch.Tensor:
    """[1, 30, 3]: away from here in one direction."""
    gone = torch.linspace(metres / 30, metres, 30)
    angle = torch.tensor(heading)
    return torch.stack([gone * torch.cos(angle), gone * torch.sin(angle), angle.expand(30)], dim=1)[None]


def around(walls: Walls, k: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    body = torch.tensor([[walls.body.reach_m, walls.body.radius_m]])
    return torch.from_numpy(walls.patches([k])).float(), body


KNOWN = torch.ones(1, 30, dtype=torch.bool)


@pytest.mark.slow
@given(k=st.integers(0, 129), heading=st.floats(-1.2, 1.2), metres=st.floats(0.1, 3.0))
def test_room_is_what_the_scene_leaves_before_and_behind_the_robot(
    walls: Walls, grid: NavGrid, k: int, heading: float, metres: float
) -> None:
    plan = straight(heading, metres)
    found = room(plan, *around(walls, k))[0].numpy()
    x, y, turn = walls.pose[k]
    xy = plan[0, :, :2].numpy() @ np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))]) + (x, y)
    reach = walls.body.reach_m * np.array((np.cos(turn + heading), np.sin(turn + heading)))
    gaps = np.minimum(grid.clearances_at(xy + reach), grid.clearances_at(xy - reach))
    # Beyond the floor the grid says -1, and between cells clearances are blended; half a cell would show.
    on_floor = gaps > 0
    np.testing.assert_allclose(found[on_floor], gaps[on_floor] - walls.body.radius_m, atol=0.045)
    assert (found[~on_floor] < 0.1 - walls.body.radius_m).all()


def test_the_walls_of_a_mirrored_drive_are_on_the_other_side(walls: Walls) -> None:
    other = SCENES.along(mirrored_drive(in_corridor()), in_mirror=True)
    assert other is not None
    np.testing.assert_allclose(other.patches([0, 90]), walls.patches([0, 90])[:, ::-1], atol=2e-3)


def test_a_plan_into_a_wall_is_pushed_out_of_it(walls: Walls) -> None:
    label, plan = straight(-0.3), straight(0.8).requires_grad_()
    cost = too_near(plan, label, KNOWN, *around(walls), 0.2)
    cost.sum().backward()
    assert cost.item() > 0 and plan.grad is not None
    before = room(plan.detach(), *around(walls))
    after = room(plan.detach() - 0.1 * plan.grad.sign(), *around(walls))
    assert after.min() > before.min()


@pytest.mark.slow
@given(heading=st.floats(-1.2, 1.2), metres=st.floats(0.1, 3.0))
def test_the_experts_plan_has_no_wall_cost(walls: Walls, heading: float, metres: float) -> None:
    plan = straight(heading, metres)
    assert too_near(plan, plan, KNOWN, *around(walls), 0.2).item() == 0


def test_steps_without_a_label_have_no_wall_cost(walls: Walls) -> None:
    known = KNOWN.clone()
    known[:, 5:] = False
    plan = straight(0.8)
    assert too_near(plan, straight(-0.3), KNOWN, *around(walls), 0.2) > 0
    assert too_near(plan, straight(-0.3), known, *around(walls), 0.2) == 0


def test_the_far_side_of_a_wall_does_not_draw_a_plan_on(walls: Walls) -> None:
    plan = straight(1.2, 5.0).requires_grad_()
    too_near(plan, straight(-0.3), KNOWN, *around(walls), 0.2).sum().backward()
    assert plan.grad is not None
    gaps = room(plan.detach(), *around(walls))[0] + walls.body.radius_m
    inside = int(torch.nonzero(gaps < -walls.body.reach_m)[0])
    assert plan.grad[0, :inside].any() and not plan.grad[0, inside + 1 :].any()


@pytest.mark.parametrize("kind", ["imported", "hospital-of-somebody"])
def test_nothing_is_near_where_the_scene_is_not_ours(kind: str) -> None:
    assert SCENES.along(side_drive("left-a", kind=kind)) is None
    patches = torch.from_numpy(nothing_near(1)).float()
    assert room(straight(0.8), patches, torch.zeros(1, 2)).unique().item() == OPEN_M


def test_a_drive_of_a_scene_that_was_built_otherwise_has_no_walls() -> None:
    drive = in_corridor()
    through = dataclasses.replace(drive, pose=drive.pose + np.array((0.0, 1.5, 0.0)))
    assert SCENES.along(drive) is not None
    assert SCENES.along(through) is None and SCENES.along(in_corridor("corridor-98")) is None


def drawn(frames: DriveFrames, tmp_path: Path) -> Group:
    plain = SampleConfig().undisturbed()
    states = SideStates(side_dataset(tmp_path))
    every = Delays.uniform(DelayConfig())
    samples = Samples([frames], MadeUpTokens(), states, every, plain, tiny_model(), drop=False)
    return samples.draw(np.random.default_rng(1))


def test_samples_have_walls_where_the_loss_uses_them(tmp_path: Path) -> None:
    drive = in_corridor()
    weights = SampleConfig().weights
    without = drawn(DriveFrames.of(drive, 30, weights), tmp_path / "a")
    given_ = drawn(DriveFrames.of(drive, 30, weights, SCENES.along(drive)), tmp_path / "b")
    assert without.around is None and given_.around is not None
    assert given_.around.patches.shape == (4, *SHAPE)
    with pytest.raises(ValueError, match="around all groups"):
        collate([without, given_], CPU)


def test_a_plan_into_walls_differs_in_loss_from_one_that_follows_the_expert(tmp_path: Path, walls: Walls) -> None:
    batch = collate([drawn(DriveFrames.of(in_corridor(), 30, SampleConfig().weights, walls), tmp_path)], CPU)
    batch = dataclasses.replace(batch, target=straight(-0.3).expand(4, -1, -1), known=KNOWN.expand(4, -1))
    assert batch.around is not None
    patches, body = around(walls)
    batch = dataclasses.replace(batch, around=(patches.expand(4, -1, -1), body.expand(4, -1)))
    into = straight(0.8).expand(4, -1, -1)
    assert plans_into_walls(into, batch).all() and not plans_into_walls(batch.target, batch).any()
    assert not plans_into_walls(into, dataclasses.replace(batch, target=into)).any()
    unknown = dataclasses.replace(batch, around=(patches.expand(4, -1, -1), torch.zeros(4, 2)))
    assert len(plans_into_walls(into, unknown)) == 0


@pytest.mark.slow
def test_imitation_reports_how_often_plans_lead_into_walls(tmp_path: Path) -> None:
    held = side_drive("left-v", VAL_LAYOUT, scene=f"office-{VAL_LAYOUT}")
    held = dataclasses.replace(held, pose=held.pose * (1.0, 0.3, 1.0) + np.array((20.5, 7.0, 0.0)))
    assert SCENES.along(held) is not None
    dataset = write_dataset(tmp_path / "collect", [in_corridor(), held])
    _, plain = trained(dataset, imitate_job(tmp_path / "plain"))
    config = dataclasses.replace(CONFIG, loss=LossConfig(walls=3.0))
    _, result = trained(dataset, imitate_job(tmp_path / "walls", config))
    assert "into_walls" not in plain["held_out"]
    assert set(result["held_out"]["into_walls"]) == {"policy", "other_words"}
    assert result["loss"] != plain["loss"]
