"""What people do about a jam: they see it from afar and go elsewhere, and they do not stand where corridors meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_hil.crowd.courtesy import Jams
from sim_hil.crowd.spots import spots_of
from sim_hil.crowd.state import Crowd
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Scene, load_scene


@pytest.fixture(scope="module")
def hall() -> Scene:
    return replace(load_scene("corridor"), objects=(), routes=())


def _jammed_at(x: float, y: float) -> tuple[Crowd, Jams]:
    """Ten people who have stood around a point for a while."""
    crowd = Crowd(10, np.random.default_rng(0))
    turns = np.arange(10) * 0.6
    crowd.x, crowd.y = x + 0.8 * np.cos(turns), y + 0.8 * np.sin(turns)
    jams = Jams(10)
    for _ in range(100):
        jams.update(crowd, 0.1)
    return crowd, jams


def test_a_way_through_a_jam_is_less_attractive_than_one_away_from_it(hall: Scene) -> None:
    ways = CrowdMap(hall)
    (x0, y0), (x1, y1) = hall.floor_min_m, hall.floor_max_m
    middle_x, middle_y = (x0 + x1) / 2, (y0 + y1) / 2
    ways.set_destinations([(x0 + 1.5, middle_y), (x1 - 1.5, middle_y)])
    _, jams = _jammed_at(middle_x + 5.0, middle_y)
    away, through = jams.prices(ways, 2, middle_x, middle_y)
    assert away == 1.0
    assert through > 5.0


def test_nobody_stands_about_where_corridors_meet() -> None:
    office = load_scene("office")
    spots = spots_of(office, CrowdMap(office), 60, np.random.default_rng((20204, 7)))
    junction = [s for s in spots if s.kind == "stand" and 22.0 < s.reach[0] < 23.8 and 5.6 < s.reach[1] < 7.4]
    assert not junction
