"""People walk, queue, sit, stay in groups and pass each other; the same seed gives the same people."""

from __future__ import annotations

import itertools
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from sim_hil.crowd.courtesy import Jams
from sim_hil.crowd.people import GESTURES, UPDATE_HZ, People, appearances
from sim_hil.crowd.spots import Destinations, spots_of
from sim_hil.crowd.state import Crowd
from sim_hil.crowd.steering import Nearby, choose
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Place, Route, Scene, Terrain, Wall, load_scene

FAR_AWAY = (-100.0, -100.0, 0.0)


@pytest.fixture(scope="module")
def corridor() -> Scene:
    return load_scene("corridor")


@pytest.fixture(scope="module")
def hall(corridor: Scene) -> Scene:
    """An empty hall of 30 m x 4 m without routes."""
    return replace(corridor, objects=(), routes=())


@pytest.fixture(scope="module")
def hospital() -> Scene:
    return load_scene("hospital")


def _walk(people: People, seconds: float) -> np.ndarray:
    """Return the render rows of every step [steps, n, RENDER_FIELDS]; the robot is far away."""
    rows = []
    for _ in range(round(seconds * UPDATE_HZ)):
        people.step(*FAR_AWAY)
        rows.append(people.render_rows())
    return np.array(rows)


def _travelled(rows: np.ndarray) -> np.ndarray:
    return np.hypot(*np.moveaxis(np.diff(rows[:, :, :2], axis=0), -1, 0)).sum(axis=0)


@pytest.mark.slow
def test_the_seed_decides_everything_and_reading_the_state_changes_nothing(corridor: Scene) -> None:
    read, unread = People(corridor, 5, 3), People(corridor, 5, 3)
    for _ in range(10 * UPDATE_HZ):
        read.step(*FAR_AWAY)
        unread.step(*FAR_AWAY)
        read.render_rows(), read.poses(), read.velocities()
    assert np.array_equal(read.render_rows(), unread.render_rows())
    assert not np.array_equal(People(corridor, 5, 3).poses(), People(corridor, 5, 4).poses())
    assert appearances(5, 3) == appearances(5, 3) != appearances(5, 4)


@pytest.mark.slow
def test_crowds_that_share_destinations_leave_nothing_behind_in_them(hospital: Scene) -> None:
    shared = Destinations.of(hospital, 10, np.random.default_rng(1))
    first, second = (_walk(People(hospital, 10, 3, shared), 10.0) for _ in range(2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, _walk(People(hospital, 10, 4, shared), 10.0))


@pytest.mark.slow
def test_people_walk_at_walking_speed_without_jumping(corridor: Scene) -> None:
    rows = _walk(People(corridor, 4, 1), 20.0)
    steps = np.hypot(*np.moveaxis(np.diff(rows[:, :, :2], axis=0), -1, 0)) * UPDATE_HZ
    assert steps.max() < 1.6
    assert 0.5 < steps.mean() < 1.4


@pytest.mark.slow
def test_people_turn_round_gradually(corridor: Scene) -> None:
    turns = np.diff(_walk(People(corridor, 4, 2), 40.0)[:, :, 2], axis=0)
    assert np.abs((turns + pi) % (2 * pi) - pi).max() * UPDATE_HZ < 3.1


def test_limbs_swing_with_walking_and_rest_at_the_start(corridor: Scene) -> None:
    people = People(replace(corridor, routes=(Route(((3.0, 0.0), (9.0, 0.0))),)), 1, 0)
    assert people.render_rows()[0, 4] == 0
    row = _walk(people, 3.0)[-1, 0]
    assert row[4] > 0.7 and 0 <= row[3] < 1


def test_a_scene_without_room_is_refused(corridor: Scene) -> None:
    with pytest.raises(ValueError, match="no room"):
        People(corridor, 2000, 0)


@pytest.mark.slow
def test_no_person_enters_walls_or_other_people(hospital: Scene) -> None:
    free = CrowdMap(hospital)
    for rows in _walk(People(hospital, 60, 2), 20.0)[::10]:
        up = rows[rows[:, 6] == 0.0]
        assert free.gaps_at(up[:, 0], up[:, 1]).min() > 0.1
        gaps = np.hypot(up[:, None, 0] - up[None, :, 0], up[:, None, 1] - up[None, :, 1])
        gaps[np.diag_indices(len(up))] = 9.0
        assert gaps.min() > 0.4


@pytest.mark.slow
def test_few_people_of_sixty_are_stuck_for_15_s(hospital: Scene) -> None:
    people = People(hospital, 60, 4)
    longest = np.zeros(60)
    for _ in range(30 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        longest = np.maximum(longest, people.blocked_s())
    assert (longest > 15.0).mean() <= 0.04


@pytest.mark.slow
def test_people_accelerate_and_brake_within_human_limits(hospital: Scene) -> None:
    people = People(hospital, 30, 0)
    before, changes = people.velocities(), []
    for _ in range(15 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        up = people.render_rows()[:, 6] == 0.0
        changes += np.hypot(*(people.velocities() - before)[up].T).tolist()
        before = people.velocities()
    accelerations = np.array(changes) * UPDATE_HZ
    assert (accelerations > 3.6).mean() < 0.005
    assert (accelerations > 1.9).mean() < 0.1


@pytest.mark.slow
def test_people_stand_sit_walk_and_talk(hospital: Scene) -> None:
    rows = _walk(People(hospital, 60, 5), 20.0)
    assert rows[:, :, 6].max() == 1.0
    assert (rows[:, :, 4].max(axis=0) > 0.8).mean() > 0.3
    for gesture in range(len(GESTURES)):
        assert (rows[:, :, 7] == gesture).any()


@pytest.mark.slow
def test_a_queue_stands_in_line_and_is_served_one_after_the_other(hall: Scene) -> None:
    counter = Place("counter", (20.0, 0.0), 0.0, "queue", 5)
    rows = _walk(People(replace(hall, places=(counter,)), 10, 3), 240.0)[::UPDATE_HZ]
    served, gaps = [], []
    for before, now in itertools.pairwise(rows):
        still = np.hypot(*(now - before)[:, :2].T) < 0.05
        line = [k for k in np.flatnonzero(still) if abs(now[k, 1]) < 0.2 and 16.5 < now[k, 0] < 20.2]
        line.sort(key=lambda k: -now[k, 0])
        if line and now[line[0], 0] > 19.6:
            served += [line[0]] if not served or served[-1] != line[0] else []
            gaps += [now[a, 0] - now[b, 0] for a, b in itertools.pairwise(line)]
    assert len(served) >= 3
    assert gaps and min(gaps) > 0.45 and np.median(gaps) < 1.0


@pytest.mark.slow
def test_sitting_people_are_on_their_seats_and_face_as_the_seats_do(hall: Scene) -> None:
    seats = tuple(Place(f"seat {k}", (4.0 + 3 * k, 1.6), -pi / 2, "sit") for k in range(6))
    rows = _walk(People(replace(hall, places=seats), 6, 1), 60.0)
    down = rows[rows[:, :, 6] == 1.0]
    assert len(down)
    settled = np.array([min(hypot(x - (4.0 + 3 * k), y - 1.6) for k in range(6)) for x, y in down[:, :2]])
    assert np.median(settled) < 0.05
    turned = np.abs((down[settled < 0.05][:, 2] + pi / 2 + pi) % (2 * pi) - pi)
    assert np.percentile(turned, 90) < 0.2


@pytest.mark.slow
def test_groups_stay_together(hospital: Scene) -> None:
    rows = _walk(People(hospital, 60, 6), 20.0)[::UPDATE_HZ]
    gaps = np.hypot(*np.moveaxis(rows[:, 1:, :2] - rows[:, :-1, :2], -1, 0))  # members of a group are neighbours
    started_together = gaps[0] < 1.5
    assert 5 <= started_together.sum() <= 40
    assert np.median(gaps[:, started_together]) < 1.3
    assert np.percentile(gaps[:, started_together], 75) < 3.0


@pytest.mark.slow
def test_two_streams_pass_each_other_in_a_narrow_corridor(hall: Scene) -> None:
    side = [Wall(f"side {y}", (2.0, y), (26.0, y), 0.1, 2.5, "wall_wainscot") for y in (-1.3, 1.3)]
    travelled = _travelled(_walk(People(replace(hall, walls=(*hall.walls, *side)), 16, 0), 40.0))
    assert np.median(travelled) > 0.5 * 40.0
    assert travelled.min() > 6.0


@pytest.mark.slow
def test_a_person_on_a_platform_stands_on_it(hall: Scene) -> None:
    stage = Terrain("stage", "platform", (15.0, 0.0, 0.0), 0.0, (10.0, 4.0), 0.2, "concrete")
    rows = _walk(People(replace(hall, terrain=(stage,)), 10, 0), 30.0)
    on_it = np.abs(rows[:, :, 0] - 15.0) < 4.5
    off_it = np.abs(rows[:, :, 0] - 15.0) > 5.5
    assert on_it.any() and off_it.any()
    assert np.allclose(rows[:, :, 5][on_it], 0.2) and np.allclose(rows[:, :, 5][off_it], 0.0)


@pytest.mark.slow
def test_streets_are_crossed_at_the_crossing() -> None:
    scene = load_scene("sidewalk")
    rows = _walk(People(scene, 50, 0), 20.0)[::UPDATE_HZ]
    areas = [scene.area_at(x, y) for x, y in rows[:, :, :2].reshape(-1, 2)]
    assert sum(area is not None and area.kind == "street" for area in areas) / len(areas) < 0.05


def _choose(hall: Scene, other: tuple[float, float, float, float], share: float) -> tuple[float, float, float]:
    """Velocity and time to collision of a person at (10, 0) who walks along x at 1.2 m/s; `other`: offset, velocity."""
    column = np.array([other]).T[:, None, :]
    near = Nearby(
        x=column[0], y=column[1], ux=column[2] + (1.2 if share == 2 else 0.0), uy=column[3],
        share=np.full(column[0].shape, share), touch=np.full(column[0].shape, 0.5),
        close=np.full(column[0].shape, 0.85),
    )  # fmt: skip
    one, zero = np.ones(1), np.zeros(1)
    forward = (1.2 * one, zero)
    vx, vy, meet = choose(CrowdMap(hall), (10 * one, zero), forward, forward, 1.2 * one, zero, near)
    return float(vx[0]), float(vy[0]), float(meet[0])


@pytest.mark.parametrize("other", [(50.0, 0.0, 0.0, 0.0), (-1.0, 0.0, 1.2, 0.0)], ids=["far ahead", "behind"])
def test_a_person_beside_the_path_changes_nothing(hall: Scene, other: tuple[float, float, float, float]) -> None:
    assert _choose(hall, other, 1)[:2] == (pytest.approx(1.2), pytest.approx(0.0, abs=1e-9))


@pytest.mark.parametrize(("other", "share"), [((2.0, 0.0, -1.2, 0.0), 2), ((1.5, 0.05, 0.0, 0.0), 1)])
def test_a_person_in_the_path_is_passed_on_the_right(
    hall: Scene, other: tuple[float, float, float, float], share: float
) -> None:
    vx, vy, meet_s = _choose(hall, other, share)
    assert vx > 0.7 and vy < -0.1 and meet_s > 1.0


def test_a_route_through_a_jam_is_less_attractive(hall: Scene) -> None:
    ways = CrowdMap(hall)
    ways.set_destinations([(hall.floor_min_m[0] + 1.5, 0.0), (hall.floor_max_m[0] - 1.5, 0.0)])
    middle = (hall.floor_min_m[0] + hall.floor_max_m[0]) / 2
    crowd, turns = Crowd(10, np.random.default_rng(0)), np.arange(10) * 0.6
    crowd.x, crowd.y = middle + 5.0 + 0.8 * np.cos(turns), 0.8 * np.sin(turns)
    jams = Jams(10)
    for _ in range(100):
        jams.update(crowd, 0.1)
    away, through = jams.prices(ways, 2, middle, 0.0)
    assert away == 1.0 and through > 5.0


def test_no_person_stands_at_a_junction_of_corridors() -> None:
    office = load_scene("office")
    spots = spots_of(office, CrowdMap(office), 60, np.random.default_rng((20204, 7)))
    assert not [s for s in spots if s.kind == "stand" and 22.0 < s.reach[0] < 23.8 and 5.6 < s.reach[1] < 7.4]
