"""Policies that replace one link of the chain by the truth: text, progress, distances, or the driving.

They read the simulator's truth, so their results say what a better link would be worth, and nothing about a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import hypot
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.inference.language import LanguageModel
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint, observed_turn
from edge.reasoning.line_constraint import Encode, Line, LineConstraint
from edge.state.reasoning_text import (
    OBJECTS_HEAD,
    PLAN_HEAD,
    PROGRESS_HEAD,
    Plan,
    ReasoningText,
    Stop,
    Turn,
    format_objects,
    format_plan,
    format_progress,
    format_text,
    parse_text,
)
from edge.state.switches import Decoding, Speculation
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.expert import ExpertPolicy, driving_of, from_here
from sim_hil.benchmark.policies.expert_motion import Motion
from sim_hil.benchmark.policies.expert_route import SPACING_M
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import max_step_m
from sim_hil.scene.nav_grid import NavGrid
from tools.train.config.collect import RATE_HZ, CollectConfig
from tools.train.drives.futures import chosen_future
from tools.train.drives.scenarios import Scenario
from tools.train.drives.traces import Tracer, turning_first

Array = NDArray[np.float64]
Velocity = tuple[float, float, float]

_PLAN_STEP: Final = 3 * RATE_HZ - 1  # index of the planned pose in 3 s
_SIGHT_M: Final = 7.0  # people beyond this distance do not change the driving, as for the expert
_END_M: Final = 0.25  # the robot stands when less than this is left of the text's route
_STEER: Final = CollectConfig(wall_m=0.1)  # the teacher's driving, as in the recipe of the shipped weights


@dataclass(frozen=True)
class Variant:
    """One replaced link; `forced_text`: which of the text is the truth; `drives`: the expert drives by the text."""

    description: str
    forced_text: Callable[[DecodingContext, Encode, ReasoningText, int], TextConstraint] | None = None
    drives: bool = False
    decoding: Decoding | None = None
    people: bool = True
    drift: str = "none"


class WholeText(TextConstraint):
    """Forces a whole text, so that keys and values are those of the model that reads it."""

    def __init__(self, context: DecodingContext, encode: Encode, truth: ReasoningText, end_id: int) -> None:
        super().__init__(DecodingContext(context.before), encode)
        self._rest = [*encode(format_text(truth)), end_id]

    def choose(self, token: int) -> int:
        """Return the text's next token."""
        return self._rest.pop(0)

    def forced(self) -> Line:
        """Return the text's remaining tokens without its end."""
        return tuple(self._rest[:-1])

    def replace_line(self, line: str) -> None:
        """Keep every line; note the turn of the plan."""
        if line.startswith(PLAN_HEAD):
            self.turn, self.has_plan = observed_turn(parse_text(line).plan), True


class TrueProgress(TextConstraint):
    """Forces the line of the progress; the model writes the rest after it."""

    def __init__(self, context: DecodingContext, encode: Encode, truth: ReasoningText, end_id: int) -> None:
        self._truth = truth
        super().__init__(replace(context, keeps_form=False), encode)

    @property
    def overruled(self) -> bool:
        """Whether the progress was the rules' choice: no, it is the truth."""
        return False

    @property
    def refused(self) -> str | None:
        """Kind of the progress that was refused: none."""
        return None

    def _constrain_progress(self) -> LineConstraint | None:
        if self._truth.progress is None:
            return None
        line = f"{PROGRESS_HEAD}{format_progress(self._truth.progress)}\n"
        return LineConstraint([tuple(self._encode(line))])


class TrueDistances(TextConstraint):
    """Replaces the line of objects and openings, and the distance of a plan of the right kind."""

    def __init__(self, context: DecodingContext, encode: Encode, truth: ReasoningText, end_id: int) -> None:
        super().__init__(replace(context, turn=None, keeps_form=False), encode)
        self._truth = truth

    def replace_line(self, line: str) -> Line | None:
        """Return the tokens of the true line where the model's line differs; None to keep it."""
        super().replace_line(line)
        true_line = line
        if line.startswith(OBJECTS_HEAD) and self._truth.objects is not None:
            true_line = f"{OBJECTS_HEAD}{format_objects(self._truth.objects)}."
        if line.startswith(PLAN_HEAD):
            plan = parse_text(line).plan
            if plan is not None and self._truth.plan is not None:
                true_line = f"{PLAN_HEAD}{format_plan(_at_true_distance(plan, self._truth.plan))}."
        return None if true_line == line else tuple(self._encode(f"{true_line}\n"))


def _at_true_distance(plan: Plan, truth: Plan) -> Plan:
    """Return a plan with the distance of the true one, if both mean the same turn or stop."""
    action, true_action = plan.action, truth.action
    if isinstance(action, Stop) and isinstance(true_action, Stop):
        return replace(plan, action=true_action)
    if isinstance(action, Turn) and isinstance(true_action, Turn) and action.side == true_action.side:
        return replace(plan, action=replace(action, distance_m=true_action.distance_m))
    return plan


VARIANTS: Final[Mapping[str, Variant]] = MappingProxyType(
    {
        "ours": Variant("our text, our action expert"),
        "expert-text": Variant("the true text, read by our language model; our action expert", forced_text=WholeText),
        "expert-driving": Variant("our text; the expert drives along its waypoints", drives=True),
        "expert-text-driving": Variant("the true text; the expert drives along its waypoints",
                                       forced_text=WholeText, drives=True),
        "free-decoding": Variant("our text without decoding rules", decoding=Decoding.FREE),
        "true-progress": Variant("our text with the true progress", forced_text=TrueProgress),
        "true-distances": Variant("our text with true objects, openings and distances", forced_text=TrueDistances),
        "no-people": Variant("as ours, without people", people=False),
        "typical-drift": Variant("as ours, with typical odometry drift; all others have perfect odometry",
                                 drift="typical"),
        "expert": Variant("the privileged expert, with its own text and driving"),
    }
)  # fmt: skip
"""Variants by name; `expert` is the upper bound and has a policy of its own."""


class TrueTexts:
    """Writes the true text of each instant, with the waypoints of the teacher, as training's drives have them."""

    def __init__(self, scenario: Scenario) -> None:
        self._tracer, self._turn_radps = Tracer(scenario), driving_of(scenario.episode.robot).turn_radps
        self._expert = ExpertPolicy(
            margin_m=_STEER.margin_m, speed_mps=_STEER.speed_mps, prescribed=scenario.task.path, patient=True,
            rests=True, wall_m=_STEER.wall_m,
        )  # fmt: skip

    def reset(self, episode: Episode, world: EpisodeWorld) -> None:
        """Begin an episode in its world."""
        shorter = replace(episode, threshold_m=_STEER.arrive_share * episode.threshold_m)
        self._world = world
        self._expert.reset(shorter, episode.instructions[0], world, episode.seed)

    def watch(self, observation: Observation) -> None:
        """Let the teacher plan one control period; another policy drives."""
        self._expert.act(observation)

    def text(self) -> ReasoningText:
        """Return the text that is true now; call it after `watch`."""
        world, choice = self._world, self._expert.choice
        assert choice is not None
        pose = world.pose()
        chosen = chosen_future(pose, choice, self._expert.route())
        plan = self._expert.plan()
        means = [turning_first(plan[0], self._turn_radps, _STEER.speed_mps)]
        driven_m = hypot(*(float(value) for value in chosen[_PLAN_STEP, :2]))
        found = self._tracer.trace(pose, world.people(), world.people_velocities(), means, driven_m)
        return replace(found, waypoints=tuple(plan))


class _TruthfulLanguage(LanguageModel):
    """Language model whose decoding is forced to the truth of each generation's newest frame."""

    variant: Variant = VARIANTS["ours"]
    truth: ReasoningText | None = None

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return the constraint that states the truth."""
        forced, end_id = self.variant.forced_text, self.runtime.im_end_id
        if forced is None or self.truth is None:
            return super().constraint(context)
        return forced(context, self.encode, self.truth, end_id)


class SplitPolicy(ArtifactsPolicy):
    """An exported model with one link replaced, for one scenario."""

    privileged = True

    def begin(self, variant: Variant, scenario: Scenario) -> None:
        """Choose the replaced link; call it before `reset`."""
        self._variant = variant
        self._texts = None if variant.forced_text is None else TrueTexts(scenario)
        if variant.forced_text is not None:
            self._truthful = _TruthfulLanguage(self._artifacts, threads=1)
            self._truthful.variant = variant
            if self._switches.speculation is Speculation.ON:
                self._truthful.speculate()
            self.language = self._truthful
        self._pilot: _Pilot | None = None

    def reset(self, episode: Episode, instruction: str, world: object | None, seed: int) -> None:
        """Begin an episode in its world."""
        super().reset(episode, instruction, None, seed)
        assert isinstance(world, EpisodeWorld)
        if self._texts is not None:
            self._texts.reset(episode, world)
        self._pilot = _Pilot(world) if self._variant.drives else None

    def act(self, observation: Observation) -> Velocity:
        """Return the command of one control period."""
        command = super().act(observation)
        notes = self.notes()
        begins = notes["thinking_s"] == 0.0  # its newest frame is this one
        if self._texts is not None:
            self._texts.watch(observation)
            if begins:
                self._truthful.truth = self._texts.text()
        return command if self._pilot is None else self._pilot.command(observation, notes, begins=begins)


class _Pilot:
    """The expert's local planner on the route that the text's waypoints describe."""

    def __init__(self, world: EpisodeWorld) -> None:
        self._world = world
        robot = world.episode.robot
        driving = driving_of(robot)
        self._driving = replace(
            driving, margin_m=driving.margin_m + _STEER.margin_m, speed_mps=_STEER.speed_mps,
            body_radius_m=driving.body_radius_m + _STEER.wall_m,
        )  # fmt: skip
        grid = NavGrid(world.scene, clearance_m=world.robot.radius_m, max_step_m=max_step_m(robot))
        self._motion = Motion(grid, self._driving)
        self._generation: object = None
        self._next_anchor = world.pose()
        self._route: Array | None = None

    def command(self, observation: Observation, notes: Mapping[str, object], *, begins: bool) -> Velocity:
        """Return the velocity along the newest waypoints; `begins`: whether a generation takes this frame."""
        pose = self._world.pose()
        if notes["generation"] != self._generation:
            self._generation = notes["generation"]
            points = notes["waypoints"]
            self._route = _dense(self._next_anchor, points) if isinstance(points, tuple) else None
        if begins:
            self._next_anchor = pose
        if self._route is not None:
            self._route = from_here(self._route, pose)
        if self._route is None or (len(self._route) - 1) * SPACING_M < _END_M:
            choice = self._motion.stand(pose.as_tuple(), observation.state[0])
            return (choice.vx_mps, 0.0, choice.wz_radps)
        people, velocities = self._world.people()[:, :2], self._world.people_velocities()
        near = np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m) < _SIGHT_M
        choice = self._motion.choose(
            pose.as_tuple(), observation.state[0], self._route, people[near], velocities[near]
        )  # fmt: skip
        return (choice.vx_mps, 0.0, choice.wz_radps)


def _dense(anchor: SE2, points: tuple[tuple[float, float], ...]) -> Array:
    """Return points [n, 2], m in the world frame, SPACING_M apart from the anchor through the waypoints."""
    places = [anchor, *(anchor @ SE2(x, y, 0.0) for x, y in points)]
    line = np.array([(place.x_m, place.y_m) for place in places])
    along = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    marks = np.arange(0.0, along[-1] + SPACING_M, SPACING_M)
    return np.stack((np.interp(marks, along, line[:, 0]), np.interp(marks, along, line[:, 1])), axis=1)
