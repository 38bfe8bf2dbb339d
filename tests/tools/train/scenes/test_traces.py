"""Traces are true: what they name is in the picture, what they count is passed, and their words are few and known."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from math import atan2, cos, hypot, pi, sin

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import WAIT, Progress, parse_progress, parse_waypoints
from sim_hil.crowd.people import RENDER_FIELDS, People
from sim_hil.scene.scene import Scene
from sim_hil.simulation.camera import CameraWorld
from tests.support.train.training_scenarios import all_scenarios, progress_of, scenarios
from tools.train.config.scenes import CORRIDOR, KINDS
from tools.train.scenes import trace_sentences as trace_words
from tools.train.scenes.scenarios import Scenario
from tools.train.scenes.traces import PEOPLE_M, Trace, Tracer

NOBODY = (np.zeros((0, 3)), np.zeros((0, 2)))
AHEAD = [(2.0, 0.0)]
WAYPOINTS = ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0))
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


def _person(pose: SE2, ahead_m: float, left_m: float) -> np.ndarray:
    """[1, 3]: somebody at a place in the robot's frame, looking at it."""
    c, s = cos(pose.theta_rad), sin(pose.theta_rad)
    x, y = pose.x_m + c * ahead_m - s * left_m, pose.y_m + s * ahead_m + c * left_m
    return np.array(((x, y, pose.theta_rad + pi),))


# -- words -----------------------------------------------------------------------------------------------------------


def test_every_sentence_of_the_corpus_is_short_and_can_be_read_back() -> None:
    for text in trace_words.corpus():
        reasoning, _, last = text.rpartition("\n")
        assert len(reasoning.split()) <= trace_words.MAX_WORDS
        assert parse_progress(reasoning) is not None
        assert parse_waypoints(text) is not None and last.startswith("waypoints: ")


def test_the_corpus_holds_every_name_place_and_way_of_moving() -> None:
    text = "\n".join(trace_words.corpus())
    phrases = [*trace_words.landmarks(), *trace_words.AREAS.values(), *trace_words.WAYS, trace_words.TURN_BACK]
    phrases += [trace_words.opening(kind) for kind in ("room", "corridor", "crossing")]
    phrases += [trace_words.NOTHING, trace_words.NOBODY, WAIT, "stop now", "cross ahead now"]
    assert [phrase for phrase in phrases if phrase not in text] == []


def test_the_corpus_is_always_the_same() -> None:
    assert list(trace_words.corpus()) == list(trace_words.corpus())


def test_whatever_a_trace_says_is_made_of_the_corpus_words() -> None:
    known = {word.strip(".,") for text in trace_words.corpus() for word in text.split()}
    for scenario in all_scenarios():
        tracer = _tracer(scenario)
        for pose in _poses(scenario, 6.0):
            said = tracer.trace(pose, *NOBODY).reasoning()
            assert {word.strip(".,") for word in said.split()} <= known, said


def test_things_for_which_there_is_no_room_are_left_out_last_ones_first() -> None:
    things = [f"yellow table with an umbrella left {m} m" for m in (1, 2, 3)]
    trace = Trace.of("in a corridor", things, ["person ahead 2 m crossing left"] * 2, Progress(1, 2, 0), "stop in 3 m")
    assert trace.objects == things[0]


def test_a_trace_that_says_too_much_is_refused() -> None:
    with pytest.raises(ValueError, match="45 words"):
        Trace("in a corridor", "door left 3 m, " * 10, "none", Progress(1, 1, 0), "stop now")


@pytest.mark.parametrize(("metres", "said"), [(0.2, "1 m"), (1.4, "1 m"), (1.6, "2 m"), (29.7, "30 m"), (80.0, "30 m")])
def test_distances_are_whole_metres_within_what_the_corpus_holds(metres: float, said: str) -> None:
    assert trace_words.distance(metres) == said


def test_a_trace_survives_a_drives_header() -> None:
    scenario = scenarios("office")[0]
    trace = _tracer(scenario).trace(SE2(*scenario.task.start), *NOBODY)
    assert Trace.from_json({"k": 10, **trace.to_json()}) == trace


def test_the_answer_is_five_lines_and_the_waypoints() -> None:
    trace = Trace("in a corridor", "none", "nobody near", Progress(2, 3, 1), "turn left into the room in 3 m")
    assert trace.text(WAYPOINTS).split("\n") == [
        "Situation: in a corridor.", "Objects: none.", "Motion: nobody near.", "Progress: turn 2 of 3, passed 1.",
        "Plan: turn left into the room in 3 m.", "waypoints: (1.0, 0.0) (2.0, 0.0) (3.0, 0.0)",
    ]  # fmt: skip


# -- progress and plan -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_plan_is_the_next_told_step_or_to_stop(kind: str) -> None:
    for scenario in scenarios(kind):
        tracer, steps = _tracer(scenario), scenario.told.steps
        for pose in _poses(scenario, 5.0):
            trace = tracer.trace(pose, *NOBODY, AHEAD)
            if trace.progress.is_last_leg:
                assert trace.plan.startswith("stop")
            elif trace.plan != trace_words.TURN_BACK:
                step = steps[trace.progress.step - 1]
                verb = "cross" if step.kind == "crossing" else "go" if step.side == "straight" else "turn"
                assert trace.plan.startswith(verb) and (step.side == "straight" or step.side in trace.plan)


def test_on_the_way_nobody_turns_back() -> None:
    for scenario in all_scenarios():
        tracer = _tracer(scenario)
        assert not [p for p in _poses(scenario, 5.0) if tracer.trace(p, *NOBODY, AHEAD).plan == trace_words.TURN_BACK]


def test_whoever_means_to_be_behind_itself_turns_back() -> None:
    scenario = scenarios(CORRIDOR)[0]
    assert _tracer(scenario).trace(SE2(*scenario.task.start), *NOBODY, [(-1.0, 0.2)]).plan == trace_words.TURN_BACK


def test_whoever_stands_before_somebody_waits() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(5.0, -0.2, 0.0)
    tracer, person, still = _tracer(scenario), _person(pose, 1.2, 0.0), np.zeros((1, 2))
    assert tracer.trace(pose, person, still, [(0.1, 0.0)]).plan.startswith(WAIT)
    assert not tracer.trace(pose, person, still, AHEAD).plan.startswith(WAIT)
    assert not tracer.trace(pose, *NOBODY, [(0.1, 0.0)]).plan.startswith(WAIT)


def test_an_opening_that_counts_is_named_on_its_side_before_one_is_there() -> None:
    checked = 0
    for scenario in all_scenarios():
        tracer, poses = _tracer(scenario), _poses(scenario, 0.1)
        for step in scenario.told.steps:
            if step.kind not in ("room", "corridor", "aisle") or step.before_kind not in ("corridor", "aisle"):
                continue
            if not step.counted or step.before_m < 4.0:
                continue
            at = min(range(len(poses)), key=lambda i: hypot(poses[i].x_m - step.at[0], poses[i].y_m - step.at[1]))
            pose = SE2(poses[at - 25].x_m, poses[at - 25].y_m, atan2(step.ahead[1], step.ahead[0]))
            assert f"{trace_words.opening(step.kind)} {step.side} " in tracer.trace(pose, *NOBODY).objects
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
def test_people_are_told_by_where_they_are_and_how_they_walk(
    place: tuple[float, float], velocity: tuple[float, float], said: str
) -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    trace = _tracer(scenario).trace(pose, _person(pose, *place), np.array((velocity,)))
    assert trace.motion == said
    assert trace.situation == "in a corridor, few people"


def test_directions_are_the_robots_not_the_worlds() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, pi)
    trace = _tracer(scenario).trace(pose, _person(pose, 3.0, 0.0), np.array(((0.0, 1.0),)))
    assert trace.motion == "person ahead 3 m crossing right"


@pytest.mark.parametrize("place", [(-2.0, 0.0), (0.0, 1.5), (PEOPLE_M + 0.2, 0.0)])
def test_nobody_behind_beside_or_far_is_spoken_of(place: tuple[float, float]) -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    assert _tracer(scenario).trace(pose, _person(pose, *place), np.zeros((1, 2))).motion == trace_words.NOBODY


def test_only_the_nearest_two_are_spoken_of_and_many_are_many() -> None:
    scenario = scenarios(CORRIDOR)[0]
    pose = SE2(13.0, 0.0, 0.0)
    people = np.concatenate([_person(pose, 2.0 + k, 0.9 - 0.45 * k) for k in range(4)])
    trace = _tracer(scenario).trace(pose, people, np.zeros((4, 2)))
    assert trace.motion.count("person") == 2
    assert trace.situation == "in a corridor, many people"


def test_what_somebody_hides_is_not_spoken_of() -> None:
    scenario = scenarios(CORRIDOR)[0]
    thing = next(thing for thing in scenario.scene.objects if thing.label == "vending machine")
    pose = SE2(thing.position_m[0] - 6.0, 0.0, 0.0)
    left_m = 1.6 * thing.position_m[1] / 6.0
    tracer = _tracer(scenario)
    assert thing.landmark in tracer.trace(pose, *NOBODY).objects
    assert thing.landmark not in tracer.trace(pose, _person(pose, 1.6, left_m), np.zeros((1, 2))).objects


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
def test_a_person_is_spoken_of_just_when_the_picture_shows_one(office: tuple[Scenario, CameraWorld]) -> None:
    scenario, world = office
    tracer, rng = _tracer(scenario), np.random.default_rng(3)
    shown = hidden = 0
    for pose in _poses(scenario, 2.0):
        for _ in range(5):
            person = _person(pose, float(rng.uniform(0.8, 5.5)), float(rng.uniform(-4.0, 4.0)))
            if scenario.site.grid.clearance_m(*person[0, :2]) < 0.25:
                continue
            pixels = _changed(_picture(world, pose, person), _picture(world, pose, _person(pose, -3.0, 0.0)))
            said = tracer.trace(pose, person, np.zeros((1, 2))).motion != trace_words.NOBODY
            assert pixels > 10 or not said, (pose, person, pixels)
            gap = max(1.0, hypot(person[0, 0] - pose.x_m, person[0, 1] - pose.y_m))
            assert pixels < max(250, 1400 / gap**2) or said, (pose, person, pixels)
            shown, hidden = shown + (pixels >= 250), hidden + (pixels <= 10)
    assert shown >= 3 and hidden >= 5


def _without(scene: Scene, label: str) -> CameraWorld:
    return CameraWorld(scene.without(label), people=1, seed=4)


@pytest.mark.slow
def test_the_goal_is_spoken_of_just_when_the_picture_shows_it(office: tuple[Scenario, CameraWorld]) -> None:
    scenario, world = office
    tracer, told = _tracer(scenario), scenario.told
    thing = next(thing for thing in scenario.scene.objects if thing.label == told.goal_label)
    bare = _without(scenario.scene, thing.label)
    try:
        nobody = np.array(((-500.0, -500.0, 0.0),))
        seen = unseen = 0
        for pose in _poses(scenario, 1.0):
            pixels = _changed(_picture(world, pose, nobody), _picture(bare, pose, nobody))
            said = tracer.trace(pose, *NOBODY).objects.startswith(thing.landmark)
            far = hypot(thing.position_m[0] - pose.x_m, thing.position_m[1] - pose.y_m) > 11.0
            assert pixels > 8 or not said, (pose, pixels)
            assert pixels < 200 or said or far, (pose, pixels)
            seen, unseen = seen + (pixels >= 40), unseen + (pixels == 0)
        assert seen >= 2 and unseen >= 1
    finally:
        bare.close()


@pytest.mark.slow
def test_a_whole_walk_through_people_can_be_told() -> None:
    scenario = scenarios("hospital")[0]
    tracer, people = _tracer(scenario), People(replace(scenario.scene, start=scenario.task.start), 20, 1)
    texts = []
    for pose in _poses(scenario, 2.0):
        texts.append(tracer.trace(pose, people.poses(), people.velocities(), AHEAD).text(WAYPOINTS))
        for _ in range(30):
            people.step(*pose.as_tuple())
    assert all(parse_progress(text) is not None and parse_waypoints(text) is not None for text in texts)
    assert any("person" in text for text in texts)
    again = _tracer(scenario).trace(_poses(scenario, 2.0)[0], *NOBODY, AHEAD)
    assert again == tracer.trace(_poses(scenario, 2.0)[0], *NOBODY, AHEAD)
