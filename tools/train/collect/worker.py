"""The worker process that records drives or tours of one or more layouts, one after the other.

A drive's random numbers depend on the collection's seed and the drive's number alone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from math import hypot
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.artifacts.files import ArtifactError
from edge.core.cli import describe_os_error
from edge.reasoning.prompt import InstructionError
from export.core.typed import build
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.expert import ExpertPolicy, driving_of
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.processes.child_process import Message
from sim_hil.scene.scene import SceneError, Vec2
from tools.train.collect.record import (
    CameraSettings,
    DrivePlan,
    NothingToLearnError,
    Recorded,
    TraceAt,
    record,
)
from tools.train.collect.steering import PolicyDriver, PolicyOptions, SteeringNoise, Velocity, draw_detour
from tools.train.collect.tour_world import TourWorld, record_tour
from tools.train.config.collect import RATE_HZ, SHARES, TRACE_EVERY, CollectConfig, TourConfig
from tools.train.drives.drive import DRIVES, EXPERT, PICTURE_PX, TOUR_DRIVER, About, Drive, Entry
from tools.train.drives.scenarios import Scenario, ScenarioError, training_episodes
from tools.train.drives.trace_sentences import aspects_json
from tools.train.drives.traces import Tracer, turning_first

MODULE: Final = "tools.train.collect.worker"
_TAG: Final = 0xC011
_PLAN_STEP: Final = 3 * RATE_HZ - 1  # index of the planned pose in 3 s


@dataclass(frozen=True)
class Order:
    """Job of one process: record drives `start` to `start + count - 1` into `folder`, except those in `skip`.

    `start` is a layout's first drive. `policy`: artifacts that drive, and their options; None if the expert drives.
    `tour`: record tours instead.
    """

    folder: str
    prefix: str
    seed: int
    scenario_seed: int
    start: int
    count: int
    skip: tuple[str, ...]
    config: CollectConfig
    policy: PolicyOptions | None = None
    tour: TourConfig | None = None

    def id(self, number: int) -> str:
        """Return the id of a drive of this collection."""
        return f"{self.prefix}{number:05d}"


@dataclass(frozen=True)
class Draw:
    """Random settings of one drive in addition to its scenario."""

    noise: bool
    camera: CameraSettings
    drift: str
    linger_s: float
    strays: bool

    @staticmethod
    def of(config: CollectConfig, seed: int, number: int) -> Draw:
        """Draw the settings of drive `number`; equal arguments give equal settings."""
        rng = np.random.default_rng((seed, number, _TAG))
        noise, sharp, drift = (float(value) for value in rng.uniform(size=3))
        quality = int(rng.integers(config.jpeg_quality_min, config.jpeg_quality_max + 1))
        linger, strays = (float(value) for value in rng.uniform(size=2))
        severe, typical = config.severe_drift_share, config.typical_drift_share
        return Draw(
            noise=noise < config.noise_share,
            camera=CameraSettings(2 * PICTURE_PX if sharp < config.sharp_share else PICTURE_PX, quality),
            drift="severe" if drift < severe else "typical" if drift < severe + typical else "none",
            linger_s=(1.0 + linger) / 2 * config.linger_s,
            strays=strays < config.stray_share,
        )


def messages(job: Message) -> Iterator[Mapping[str, Any]]:
    """Record an order; yield `{"begun": id}`, then `{"drive": entry}` or `{"dropped": id, "why": …}`, for each drive.

    `{"refused": …}` ends the order: the policy's artifacts cannot be used.
    """
    order = build(Order, job, "order")
    size = order.tour.per_layout if order.tour is not None else order.config.drives_per_layout
    if order.start % size:
        raise ValueError("an order begins with a layout's first drive")
    end = order.start + order.count
    for start in range(order.start, end, size):
        numbers = range(start, min(start + size, end))
        if any(order.id(number) not in order.skip for number in numbers):
            for message in _of_layout(order, numbers, size):
                yield message
                if "refused" in message:
                    return


def _of_layout(order: Order, numbers: range, size: int) -> Iterator[Mapping[str, Any]]:
    """Record some of the `size` drives of one layout; yield the messages of each."""
    kinds = (order.tour.kinds if order.tour is not None else {}) or order.config.kinds or SHARES
    turned_share = (order.tour or order.config).turned_share
    try:
        scenarios = list(
            training_episodes(
                order.scenario_seed, len(numbers), kinds, start=numbers[0], tasks_per_scene=size,
                turned_share=turned_share,
            )
        )  # fmt: skip
    except ScenarioError:
        for number in numbers:
            yield {"dropped": order.id(number), "why": "no such layout"}
        return
    with ExitStack() as stack:
        worlds: dict[int, TourWorld] = {}
        for number, scenario in zip(numbers, scenarios, strict=True):
            drive_id = order.id(number)
            if drive_id in order.skip:
                continue
            yield {"begun": drive_id}
            try:
                if order.tour is None:
                    entry = _drive(order, number, scenario)
                else:
                    seed = scenario.layout_seed
                    if seed not in worlds:
                        worlds[seed] = _tour_world(order.tour, scenario, scenarios)
                        stack.callback(worlds[seed].close)
                    entry = _tour(order, order.tour, number, scenario, worlds[seed])
                yield {"drive": asdict(entry)}
            except (NothingToLearnError, SceneError) as error:
                yield {"dropped": drive_id, "why": str(error)}
            except InstructionError:
                yield {"dropped": drive_id, "why": "its instruction is too long for the model"}
            except ArtifactError as error:
                yield {"refused": str(error)}
                return
            except OSError as error:  # such as a full disk: the drives left out now would be left out for good
                yield {"refused": describe_os_error(error, str(order.folder))}
                return


def _drive(order: Order, number: int, scenario: Scenario) -> Entry:
    config = order.config
    draw = Draw.of(config, order.seed, number)
    threshold_m = scenario.episode.threshold_m
    episode = replace(scenario.episode, id=order.id(number), threshold_m=config.arrive_share * threshold_m)
    detour = None
    if draw.strays and order.policy is None:
        way_rng = np.random.default_rng((order.seed, number, _TAG, 3))
        detour = draw_detour(
            scenario.site, episode.robot, scenario.task, config.stray_m, way_rng, into_m=config.stray_into_m
        )
    plan = DrivePlan(
        episode=episode,
        scene=scenario.scene,
        path=np.array(scenario.task.path, np.float64),
        camera=draw.camera,
        drift=draw.drift,
        policy_drives=order.policy is not None,
        linger_s=draw.linger_s,
        detour=detour,
        legs=config.legs,
        off_m=DrivePlan.off_m + (0.0 if detour is None else detour.for_m),
    )
    rng = np.random.default_rng((order.seed, number, _TAG, 1))
    # On a detour or under a policy, no progress towards the goal does not mean that a person blocks the expert.
    expert = ExpertPolicy(
        margin_m=config.margin_m,
        speed_mps=config.speed_mps,
        prescribed=scenario.task.path,
        patient=plan.policy_drives or detour is not None,
        rests=True,
        wall_m=config.wall_m,
        about_left=True,
    )
    if order.policy is not None:
        with PolicyDriver(order.policy, episode, rng) as policy:
            trace_at = _trace_at(scenario, config.speed_mps, policy)
            recorded, driver = record(plan, expert, policy.steer, trace_at), policy.name
    else:
        noise = SteeringNoise(rng) if draw.noise else None

        def steer(_: Observation, wanted: Velocity) -> tuple[Velocity, int]:
            return (wanted, EXPERT) if noise is None else noise.command(wanted)

        recorded = record(plan, expert, steer, _trace_at(scenario, config.speed_mps))
        driver = "expert-noise" if draw.noise else "expert"
    return _saved(order, Drive(_about(scenario, order.id(number), recorded, driver, draw), **recorded.arrays))


def _tour_world(tour: TourConfig, scenario: Scenario, scenarios: Sequence[Scenario]) -> TourWorld:
    """Build the world of a scenario's layout; the layout's first scenario determines the number of people."""
    first = next(each for each in scenarios if each.layout_seed == scenario.layout_seed)
    return TourWorld(scenario.site, min(first.episode.people, tour.people_most))


def _tour(order: Order, tour: TourConfig, number: int, scenario: Scenario, world: TourWorld) -> Entry:
    draw = Draw.of(order.config, order.seed, number)
    rng = np.random.default_rng((order.seed, number, _TAG, 2))
    recorded = record_tour(scenario, world, tour, draw.camera, draw.drift, order.config, rng)
    about = replace(_about(scenario, order.id(number), recorded, TOUR_DRIVER, draw), people=world.count)
    return _saved(order, Drive(about, **recorded.arrays))


def _saved(order: Order, drive: Drive) -> Entry:
    path = Path(order.folder) / DRIVES / f"{drive.id}.safetensors"
    drive.save(path)
    return Entry.of(drive, path)


def _trace_at(scenario: Scenario, speed_mps: float, policy: PolicyDriver | None = None) -> TraceAt:
    tracer, driving = Tracer(scenario), driving_of(scenario.episode.robot)

    def trace_at(world: EpisodeWorld, chosen: NDArray[np.float64], plan_xy: Sequence[Vec2]) -> Mapping[str, Any]:
        # Whether to turn back is the route's matter; stepping back from a person is not turning back.
        means = [turning_first(plan_xy[0], driving.turn_radps, speed_mps)]
        driven_m = hypot(*(float(v) for v in chosen[_PLAN_STEP, :2]))
        text = tracer.trace(world.pose(), world.people(), world.people_velocities(), means, driven_m)
        said = None if policy is None else policy.progress()
        believed = {} if said is None else {"believed": asdict(said)}
        return {**aspects_json(text), "off_m": tracer.off_m(world.pose()), **believed}

    return trace_at


def _about(scenario: Scenario, drive_id: str, recorded: Recorded, driver: str, draw: Draw) -> About:
    episode = scenario.episode
    traces = tuple({"k": TRACE_EVERY * i, **trace} for i, trace in enumerate(recorded.traces))
    return About(
        id=drive_id,
        kind=scenario.kind,
        layout_seed=scenario.layout_seed,
        scene=scenario.scene.name,
        robot=episode.robot,
        people=episode.people,
        seed=episode.seed,
        driver=driver,
        drift=draw.drift,
        goal_xy=episode.goal_xy,
        threshold_m=episode.threshold_m,
        outcome=recorded.outcome,
        collided=recorded.collided,
        wordings=scenario.wordings,
        told=tuple(scenario.steps_json()),
        traces=traces,
    )


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {MODULE}", messages))
