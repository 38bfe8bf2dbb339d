"""What people do among each other: go to places, queue, sit, walk in groups, get past, never through anything."""

from __future__ import annotations

import itertools
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from sim_hil.crowd.people import GESTURES, RENDER_FIELDS, UPDATE_HZ, People
from sim_hil.crowd.state import Activity
from sim_hil.crowd.steering import Nearby, choose
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Place, Scene, Terrain, Wall, load_scene

FAR_AWAY = (-100.0, -100.0, 0.0)


@pytest.fixture(scope="module")
def hall() -> Scene:
    """A bare hall of 30 m x 4 m without routes: people choose their own ways."""
    return replace(load_scene("corridor"), objects=(), routes=())


@pytest.fixture(scope="module")
def hospital() -> Scene:
    return load_scene("hospital")


def _walk(people: People, seconds: float) -> np.ndarray:
    """[steps, n, RENDER_FIELDS]"""
    rows = []
    for _ in range(round(seconds * UPDATE_HZ)):
        people.step(*FAR_AWAY)
        rows.append(people.render_rows())
    return np.array(rows)


@pytest.mark.slow
def test_a_crowd_repeats_itself_whether_or_not_it_is_looked_at(hospital: Scene) -> None:
    watched, alone = People(hospital, 45, 1), People(hospital, 45, 1)
    for _ in range(120):
        watched.step(*FAR_AWAY)
        alone.step(*FAR_AWAY)
        watched.render_rows(), watched.poses(), watched.velocities()
    assert np.array_equal(watched.render_rows(), alone.render_rows())
    assert watched.render_rows().shape == (45, RENDER_FIELDS)


@pytest.mark.slow
def test_nobody_gets_into_walls_or_other_people(hospital: Scene) -> None:
    people = People(hospital, 60, 2)
    free = CrowdMap(hospital)
    for step in range(20 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        if step % 10 == 0:
            rows = people.render_rows()
            up = rows[rows[:, 6] == 0.0]
            assert free.gaps_at(up[:, 0], up[:, 1]).min() > 0.1
            gaps = np.hypot(up[:, None, 0] - up[None, :, 0], up[:, None, 1] - up[None, :, 1])
            gaps[np.diag_indices(len(up))] = 9.0
            assert gaps.min() > 0.4


@pytest.mark.slow
def test_hardly_anybody_is_stuck_for_15_s_among_sixty(hospital: Scene) -> None:
    people = People(hospital, 60, 4)
    longest = np.zeros(60)
    for _ in range(30 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        longest = np.maximum(longest, people.blocked_s())
    assert (longest > 15.0).mean() <= 0.04


@pytest.mark.slow
def test_people_speed_up_gently_and_brake_within_what_legs_can_do(hospital: Scene) -> None:
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
def test_a_queue_stands_in_line_and_is_served_in_order(hall: Scene) -> None:
    counter = Place("counter", (20.0, 0.0), 0.0, "queue", 5)
    people = People(replace(hall, places=(counter,)), 6, 3)
    crowd, served = people._crowd, []
    deepest = 0
    for person in range(6):
        people._plans._go(person, 0)
    for _ in range(60 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        line = people._plans._queues[0]
        waiting = [k for k in line if hypot(crowd.vx[k], crowd.vy[k]) < 0.05 and crowd.stuck_s[k] == 0.0]
        deepest = max(deepest, len(waiting))
        for ahead, behind in itertools.pairwise(line):
            if ahead in waiting and behind in waiting:
                assert 0.45 < hypot(crowd.x[ahead] - crowd.x[behind], crowd.y[ahead] - crowd.y[behind]) < 1.6
        if line and (not served or served[-1] != line[0]):
            served.append(line[0])
    assert deepest >= 2
    assert len(served) >= 3


@pytest.mark.slow
def test_who_sits_is_on_the_seat_and_looks_where_it_looks(hall: Scene) -> None:
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
    people = People(hospital, 60, 6)
    crowd = people._crowd
    followers = np.flatnonzero(crowd.leader >= 0)
    assert 5 <= len(followers) <= 40
    gaps = []
    for step in range(20 * UPDATE_HZ):
        people.step(*FAR_AWAY)
        if step % UPDATE_HZ == 0:
            lead = crowd.leader[followers]
            gaps.append(np.hypot(crowd.x[followers] - crowd.x[lead], crowd.y[followers] - crowd.y[lead]))
    assert np.median(gaps) < 1.3
    assert np.percentile(gaps, 75) < 3.0


@pytest.mark.slow
def test_two_streams_get_past_each_other_in_a_narrow_corridor(hall: Scene) -> None:
    side = [Wall(f"side {y}", (2.0, y), (26.0, y), 0.1, 2.5, "wall_wainscot") for y in (-1.3, 1.3)]
    narrow = replace(hall, walls=(*hall.walls, *side), places=())
    people = People(narrow, 16, 0)
    rows = _walk(people, 40.0)
    travelled = np.hypot(*np.moveaxis(np.diff(rows[:, :, :2], axis=0), -1, 0)).sum(axis=0)
    assert np.median(travelled) > 0.5 * 40.0
    assert travelled.min() > 6.0


def test_a_person_on_a_platform_stands_on_it(hall: Scene) -> None:
    stage = Terrain("stage", "platform", (15.0, 0.0, 0.0), 0.0, (10.0, 4.0), 0.2, "concrete")
    rows = _walk(People(replace(hall, terrain=(stage,)), 10, 0), 30.0)
    on_it = np.abs(rows[:, :, 0] - 15.0) < 4.5
    off_it = np.abs(rows[:, :, 0] - 15.0) > 5.5
    assert on_it.any() and off_it.any()
    assert np.allclose(rows[:, :, 5][on_it], 0.2) and np.allclose(rows[:, :, 5][off_it], 0.0)


@pytest.mark.slow
def test_streets_are_crossed_at_the_crossing_rather_than_anywhere() -> None:
    scene = load_scene("sidewalk")
    people = People(scene, 50, 0)
    rows = _walk(people, 20.0)[::UPDATE_HZ]
    kinds = [scene.area_at(x, y) for x, y in rows[:, :, :2].reshape(-1, 2)]
    streets = sum(area is not None and area.kind == "street" for area in kinds)
    assert streets / len(kinds) < 0.05


def _choose(hall: Scene, others: list[tuple[float, float, float, float]], share: float) -> tuple[float, float, float]:
    """What a person at (10, 0) who walks along x at 1.2 m/s picks, others at (x, y) offsets with velocities."""
    column = np.array(others).T[:, None, :]
    near = Nearby(
        x=column[0], y=column[1], ux=column[2] + (1.2 if share == 2 else 0.0), uy=column[3],
        share=np.full(column[0].shape, share), touch=np.full(column[0].shape, 0.5),
        close=np.full(column[0].shape, 0.85),
    )  # fmt: skip
    one, zero = np.ones(1), np.zeros(1)
    vx, vy, meet = choose(
        CrowdMap(hall), (10 * one, zero), (1.2 * one, zero), (1.2 * one, zero), 1.2 * one, zero, near
    )  # fmt: skip
    return float(vx[0]), float(vy[0]), float(meet[0])


def test_an_open_way_is_walked_as_one_likes(hall: Scene) -> None:
    vx, vy, _ = _choose(hall, [(50.0, 0.0, 0.0, 0.0)], 1)
    assert (vx, vy) == (pytest.approx(1.2), pytest.approx(0.0, abs=1e-9))


def test_two_who_meet_head_on_both_pass_on_the_right(hall: Scene) -> None:
    vx, vy, meet = _choose(hall, [(2.0, 0.0, -1.2, 0.0)], 2)
    assert vx > 0.7 and vy < -0.1 and meet > 1.0


def test_who_stands_is_walked_round(hall: Scene) -> None:
    vx, vy, _ = _choose(hall, [(1.5, 0.05, 0.0, 0.0)], 1)
    assert vx > 0.7 and vy < -0.15


def test_what_is_behind_changes_nothing(hall: Scene) -> None:
    assert _choose(hall, [(-1.0, 0.0, 1.2, 0.0)], 1)[:2] == (pytest.approx(1.2), pytest.approx(0.0, abs=1e-9))


def test_everybody_does_something_known(hospital: Scene) -> None:
    people = People(hospital, 30, 9)
    known = {Activity.WALK, Activity.FOLLOW, Activity.HOLD, Activity.QUEUE, Activity.SIT}
    assert set(people._crowd.activity.tolist()) <= known
