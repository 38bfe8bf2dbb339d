"""Traces are true: what they name is in the picture, what they count is passed, and their words are few and known."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from math import atan2, cos, hypot, pi, sin

import numpy as np
import pytest

from edge.core.geometry import SE2, wrap_angle
from edge.state.reasoning_text import (
    AREAS,
    MOTIONS,
    Plan,
    Progress,
    ReasoningText,
    SeenObject,
    SeenPerson,
    Situation,
    Stop,
    Turn,
    TurnBack,
    format_people,
    format_text,
    parse_text,
)
from sim_hil.benchmark.language.openings import Frame
from sim_hil.crowd.people import RENDER_FIELDS
from sim_hil.scene.scene import Scene
from sim_hil.simulation.camera import CameraWorld
from tests.support.train.training_scenarios import all_scenarios, progress_of, scenarios
from tools.train.config.collect import CORRIDOR, KINDS
from tools.train.drives import trace_sentences as trace_words
from tools.train.drives.scenarios import Scenario
from tools.train.drives.traces import PEOPLE_M, Tracer

NOBODY = (np.zeros((0, 3)), np.zeros((0, 2)))
AHEAD = [(2.0, 0.0)]
PX = 128
CHANGED = 24  # levels of a colour: less is shading


def _poses(scenario: Scenario, every_m: float = 1.0) -> list[SE2]:
    """Along the told way, looking along it."""
    poses = []
    for a, b in itertools.pairwise(scenario.task.path):
        length, heading = hypot(b[0] - a[0], b[1] - a[1]), atan2(b[1] - a[1], b[0] - a[0])
        count = max(1, round(length / every_m))
        poses += [
            SE2(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count, heading) for k in range(count)
        ]
    return poses


def _tracer(scenario: Scenario) -> Tracer:
    return Tracer(scenario, progress_of(scenario))


def _names(text: ReasoningText) -> list[str]:
    return [seen.name for seen in text.objects or ()]


def _waits(text: ReasoningText) -> bool:
    return text.plan is not None and text.plan.waits


def _person(pose: SE2, ahead_m: float, left_m: float) -> np.ndarray:
    """[1, 3]: somebody at a place in the robot's frame, looking at it."""
    c, s = cos(pose.theta_rad), sin(pose.theta_rad)
    x, y = pose.x_m + c * ahead_m - s * left_m, pose.y_m + s * ahead_m + c * left_m
    return np.array(((x, y, pose.theta_rad + pi),))


# -- words -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_text_of_the_corpus_is_short_and_is_read_back_whole() -> None:
    for text in trace_words.corpus():
        assert len(text.rpartition("\n")[0].split()) <= trace_words.MAX_WORDS
        assert format_text(parse_text(text)) == text


def test_the_corpus_holds_every_name_area_and_motion() -> None:
    text = "\n".join(trace_words.corpus())
    phrases = [*trace_words.landmarks(), *AREAS.values(), *MOTIONS, "turn back", "wait, then ", "stop now"]
    phrases += [trace_words.opening_name(kind) for kind in ("room", "corridor", "crossing")]
    phrases += [trace_words.NO_OBJECTS, trace_words.NO_PEOPLE, "cross ahead now"]
    assert [phrase for phrase in phrases if phrase not in text] == []


CORRIDOR_HERE, STOP = Situation("corridor"), Plan(Stop(3))


def test_objects_for_which_there_is_no_room_are_left_out_last_ones_first() -> None:
    objects = [SeenObject("yellow table with an umbrella", "left", m) for m in (1, 2, 3)]
    people = [SeenPerson("ahead", 2, "crossing left")] * 2
    text = trace_words.five_aspects(CORRIDOR_HERE, objects, people, Progress(1, 2, 0), STOP)
    assert text.objects == (objects[0],)


def test_the_five_aspects_survive_a_drives_header() -> None:
    scenario = scenarios("office")[0]
    text = _tracer(scenario).trace(SE2(*scenario.task.start), *NOBODY)
    assert trace_words.aspects_of_json({"k": 10, **trace_words.aspects_json(text)}) == text


@pytest.mark.parametrize(
    "wrong", [{"situation": "in a cave"}, {"plan": "fly"}, {"objects": "a desk"}, {"motion": "cars"}]
)
def test_a_header_that_does_not_match_the_grammar_is_refused(wrong: dict[str, str]) -> None:
    text = trace_words.five_aspects(CORRIDOR_HERE, [], [], Progress(1, 1, 0), STOP)
    (value,) = wrong.values()
    with pytest.raises(ValueError, match=f"{value}.*grammar"):
        trace_words.aspects_of_json({**trace_words.aspects_json(text), **wrong})


# -- progress and plan -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [CORRIDOR, *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != CORRIDOR)])
def test_the_plan_is_the_next_described_step_or_to_stop(kind: str) -> None:
    for scenario in scenarios(kind):
        tracer, steps = _tracer(scenario), scenario.route.steps
        for pose in _poses(scenario, 5.0):
            trace = tracer.trace(pose, *NOBODY, AHEAD)
            assert trace.progress is not None and trace.plan is not None
            action = trace.plan.action
            if trace.progress.is_last_leg:
                assert isinstance(action, Stop)
            elif not isinstance(action, TurnBack):
                step = steps[trace.progress.step - 1]
                assert isinstance(action, Turn)
                assert (action.side, action.area) == ("ahead" if step.side == "straight" else step.side, step.kind)


def test_a_goal_behind_the_robot_gives_turn_back() -> None:
    scenario = scenarios(CORRIDOR)[0]
    assert _tracer(scenario).trace(SE2(*scenario.task.start), *NOBODY, [(-1.0, 0.2)]).plan == Plan(TurnBack())


@pytest.mark.slow
def test_past_a_missed_opening_the_plan_is_to_turn_back_and_then_to_turn_to_the_other_side() -> None:
    checked = 0
    for scenario in all_scenarios():
        tracer = _tracer(scenario)
        for index, step in enumerate(scenario.route.steps):
            if step.ordinal == 0 or step.side == "straight":
                continue
            frame, taken = Frame(step.ahead), step.counted[step.ordinal - 1]
            x, y = frame.point(taken.high_m + 0.6, frame.across(step.at))
            onward_rad = atan2(step.ahead[1], step.ahead[0])
            progress = tracer.progress.at(SE2(x, y, 0.0))
            if progress.step != index + 1 or progress.passed < step.ordinal:
                continue  # a wall is there
            onward = tracer.trace(SE2(x, y, onward_rad), *NOBODY, AHEAD).plan
            back = tracer.trace(SE2(x, y, wrap_angle(onward_rad + pi)), *NOBODY, AHEAD).plan
            assert onward == Plan(TurnBack())
            assert back is not None and isinstance(back.action, Turn)
            assert (back.action.side, back.action.area) == ("left" if step.side == "right" else "right", step.kind)
            checked += 1
    assert checked >= 3


@pytest.mark.slow
def test_off_the_route_the_plan_is_to_turn_back_to_a_point_aside_unless_a_near_turn_leads_there() -> None:
    scenario = scenarios("office")[0]
    tracer, aside = _tracer(scenario), [(0.2, 2.0)]
    found = {False: 0, True: 0}
    (x0, y0), (x1, y1) = scenario.scene.floor_min_m, scenario.scene.floor_max_m
    places = itertools.product(np.arange(x0, x1, 1.0), np.arange(y0, y1, 1.0))
    for pose in (SE2(float(x), float(y), 0.0) for x, y in places if scenario.site.grid.is_free(x, y)):
        explained = tracer.trace(pose, *NOBODY, AHEAD).plan
        assert explained is not None
        action = explained.action
        if isinstance(action, TurnBack):
            continue
        near_left = action.distance_m <= 3 and (isinstance(action, Stop) or action.side == "left")
        returns = tracer.progress.strayed_m(pose) > 1.0 and not near_left
        assert tracer.trace(pose, *NOBODY, aside).plan == (Plan(TurnBack()) if returns else explained)
        found[returns] += 1
    assert min(found.values()) >= 5


def test_stepping_back_from_a_person_is_not_turning_back() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(5.0, -0.2, 0.0)
    text = _tracer(scenario).trace(pose, _person(pose, 1.2, 0.0), np.zeros((1, 2)), AHEAD, 0.4)
    assert _waits(text) and text.plan is not None and not isinstance(text.plan.action, TurnBack)


def test_a_robot_that_stands_before_a_person_waits() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(5.0, -0.2, 0.0)
    tracer, person, still = _tracer(scenario), _person(pose, 1.2, 0.0), np.zeros((1, 2))
    assert _waits(tracer.trace(pose, person, still, [(0.1, 0.0)]))
    assert not _waits(tracer.trace(pose, person, still, AHEAD))
    assert not _waits(tracer.trace(pose, *NOBODY, [(0.1, 0.0)]))


@pytest.mark.slow
def test_an_opening_that_counts_is_named_on_its_side_before_one_is_there() -> None:
    checked = 0
    for scenario in all_scenarios():
        tracer, poses = _tracer(scenario), _poses(scenario, 0.1)
        for step in scenario.route.steps:
            if step.kind not in ("room", "corridor", "aisle") or step.before_kind not in ("corridor", "aisle"):
                continue
            if not step.counted or step.before_m < 4.0:
                continue
            at = min(range(len(poses)), key=lambda i: hypot(poses[i].x_m - step.at[0], poses[i].y_m - step.at[1]))
            pose = SE2(poses[at - 25].x_m, poses[at - 25].y_m, atan2(step.ahead[1], step.ahead[0]))
            seen = {(each.name, each.side) for each in tracer.trace(pose, *NOBODY).objects or ()}
            assert (trace_words.opening_name(step.kind), step.side) in seen
            checked += 1
    assert checked >= 3


# -- people ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "velocity", "said"),
    [
        ((3.0, 0.0), (-1.0, 0.0), "person ahead 3 m coming"),
        ((3.0, 0.0), (1.0, 0.1), "person ahead 3 m leaving"),
        ((3.0, 0.0), (0.1, 1.0), "person ahead 3 m crossing left"),
        ((3.0, 0.0), (0.1, -1.0), "person ahead 3 m crossing right"),
        ((3.0, 0.0), (0.05, 0.05), "person ahead 3 m standing"),
        ((2.0, 1.1), (-0.8, -0.5), "person left 2 m coming"),
        ((2.0, -1.1), (0.0, 0.0), "person right 2 m standing"),
    ],
)
def test_people_are_described_by_place_and_motion(
    place: tuple[float, float], velocity: tuple[float, float], said: str
) -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    trace = _tracer(scenario).trace(pose, _person(pose, *place), np.array((velocity,)))
    assert format_people(trace.people or ()) == said
    assert trace.situation == Situation("corridor", crowd=1)


@pytest.mark.parametrize("place", [(-2.0, 0.0), (0.0, 1.5), (PEOPLE_M + 0.2, 0.0)])
def test_people_behind_beside_or_far_are_not_mentioned(place: tuple[float, float]) -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    assert _tracer(scenario).trace(pose, _person(pose, *place), np.zeros((1, 2))).people == ()


def test_only_the_nearest_two_people_are_mentioned_and_a_crowd_is_many() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    people = np.concatenate([_person(pose, 2.0 + k, 0.9 - 0.45 * k) for k in range(4)])
    trace = _tracer(scenario).trace(pose, people, np.zeros((4, 2)))
    assert len(trace.people or ()) == 2
    assert trace.situation == Situation("corridor", crowd=2)


def test_landmarks_hidden_by_a_person_are_not_mentioned() -> None:
    scenario = scenarios(CORRIDOR)[0]
    thing = next(thing for thing in scenario.scene.objects if thing.label == "vending machine")
    pose = SE2(thing.position_m[0] - 6.0, 0.0, 0.0)
    left_m = 1.6 * thing.position_m[1] / 6.0
    tracer = _tracer(scenario)
    assert thing.landmark in _names(tracer.trace(pose, *NOBODY))
    assert thing.landmark not in _names(tracer.trace(pose, _person(pose, 1.6, left_m), np.zeros((1, 2))))


# -- true to the picture ---------------------------------------------------------------------------------------------


def _state(pose: SE2, people: np.ndarray) -> np.ndarray:
    rows = np.zeros((len(people), RENDER_FIELDS))
    rows[:, :3] = people
    half = pose.theta_rad / 2
    robot = (pose.x_m, pose.y_m, 0.31, 0, 0, sin(half), cos(half), *(0.0, 0.85, -1.7) * 4)
    return np.array((*robot, *rows.ravel()))


def _picture(world: CameraWorld, pose: SE2, people: np.ndarray) -> np.ndarray:
    return world.render(_state(pose, people), PX, PX, aspect=16 / 9).astype(np.int64)


def _changed(a: np.ndarray, b: np.ndarray) -> int:
    """Pixels that are clearly different."""
    return int(np.sum(np.abs(a - b).max(axis=2) >= CHANGED))


def _on_go2(scenario: Scenario) -> Scenario:
    return replace(scenario, episode=replace(scenario.episode, robot="go2"))


@pytest.fixture(scope="module")
def office() -> Iterator[tuple[Scenario, CameraWorld]]:
    scenario = _on_go2(scenarios("office")[0])
    world = CameraWorld(scenario.scene, people=1, seed=4)
    yield scenario, world
    world.close()


@pytest.mark.slow
def test_a_person_is_mentioned_exactly_when_visible(office: tuple[Scenario, CameraWorld]) -> None:
    scenario, world = office
    tracer, rng = _tracer(scenario), np.random.default_rng(3)
    shown = hidden = 0
    for pose in _poses(scenario, 2.0):
        for _ in range(5):
            person = _person(pose, float(rng.uniform(0.8, 5.5)), float(rng.uniform(-4.0, 4.0)))
            if scenario.site.grid.clearance_m(*person[0, :2]) < 0.25:
                continue
            pixels = _changed(_picture(world, pose, person), _picture(world, pose, _person(pose, -3.0, 0.0)))
            said = tracer.trace(pose, person, np.zeros((1, 2))).people != ()
            assert pixels > 10 or not said, (pose, person, pixels)
            gap = max(1.0, hypot(person[0, 0] - pose.x_m, person[0, 1] - pose.y_m))
            assert pixels < max(250, 1400 / gap**2) or said, (pose, person, pixels)
            shown, hidden = shown + (pixels >= 250), hidden + (pixels <= 10)
    assert shown >= 3 and hidden >= 5


def _without(scene: Scene, label: str) -> CameraWorld:
    rest = tuple(thing for thing in scene.objects if thing.label != label)
    return CameraWorld(replace(scene, objects=rest), people=1, seed=4)


@pytest.mark.slow
def test_the_goal_is_mentioned_exactly_when_visible(office: tuple[Scenario, CameraWorld]) -> None:
    scenario, world = office
    tracer, route = _tracer(scenario), scenario.route
    thing = next(thing for thing in scenario.scene.objects if thing.label == route.goal_label)
    bare = _without(scenario.scene, thing.label)
    try:
        nobody = np.array(((-500.0, -500.0, 0.0),))
        seen = unseen = 0
        for pose in _poses(scenario, 1.0):
            pixels = _changed(_picture(world, pose, nobody), _picture(bare, pose, nobody))
            said = _names(tracer.trace(pose, *NOBODY))[:1] == [thing.landmark]
            far = hypot(thing.position_m[0] - pose.x_m, thing.position_m[1] - pose.y_m) > 11.0
            assert pixels > 8 or not said, (pose, pixels)
            assert pixels < 200 or said or far, (pose, pixels)
            seen, unseen = seen + (pixels >= 40), unseen + (pixels == 0)
        assert seen >= 2 and unseen >= 1
    finally:
        bare.close()
