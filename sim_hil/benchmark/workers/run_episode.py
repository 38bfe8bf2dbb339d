"""One whole episode: a new world, a policy, a record; on the lockstep or the real-time clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.policies.artifacts_policy import START_NS, ArtifactsPolicy
from sim_hil.benchmark.policies.policy import Policy
from sim_hil.benchmark.policies.select import camera_for, open_policy
from sim_hil.benchmark.results.flight import EpisodeFlight
from sim_hil.benchmark.results.record import EpisodeLog, EpisodeResult
from sim_hil.benchmark.workers.task import EpisodeTask, episode_result
from sim_hil.scene.scene import Scene

if TYPE_CHECKING:
    from sim_hil.benchmark.results.video import EpisodeVideo

OnTime = Callable[[float], None]
"""Callback that receives the episode's time, s, from time to time."""


def run_lockstep(task: EpisodeTask, on_time: OnTime) -> EpisodeResult:
    """Run an episode in virtual time: the world waits for the policy, so the same task gives identical results."""
    started_ns = time.monotonic_ns()
    with closing(open_policy(task.conditions, task.manifest_sha256)) as policy:
        return drive(task, policy, on_time, started_ns=started_ns)


def drive(
    task: EpisodeTask, policy: Policy, on_time: OnTime, *, started_ns: int, scene: Scene | None = None
) -> EpisodeResult:  # fmt: skip
    """Let a policy drive an episode in virtual time; `scene` replaces opening the episode's scene by name.

    `started_ns`: when the task began, by time.monotonic_ns.
    """
    episode, log = task.episode, EpisodeLog()
    with ExitStack() as cleanup:
        options = WorldOptions(camera=camera_for(task.conditions, policy), drift=task.conditions.drift)
        world = EpisodeWorld(episode, options, scene=scene)
        cleanup.callback(world.close)
        video = None if task.video == "none" else _video(task)
        if video is not None:
            cleanup.callback(video.discard)
        flight = None
        if task.flights != "none" and isinstance(policy, ArtifactsPolicy):
            policy.recorder = flight = EpisodeFlight(task.flight_path, world.scene, episode)
        policy.reset(episode, task.instruction, world if policy.privileged else None, episode.seed)
        while not world.done:
            observation = world.observe()
            command = policy.act(observation)
            if flight is not None:
                stamp_ns = START_NS + round(observation.time_s * 1e9)
                flight.see(stamp_ns, world.pose(), world.people(), world.touching)
            notes = policy.notes()
            delay_s = notes.get("delay_s")
            log.add(
                observation.time_s,
                world.pose(),
                observation.T_odom_base,
                command,
                delay_s if isinstance(delay_s, float) else None,
            )
            if video is not None:
                video.add(world, observation, command, notes)
            world.step(command)
            on_time(observation.time_s)
        outcome, notes = world.outcome(), policy.notes()
        generations = getattr(policy, "generations", lambda: None)()
        log.write(task.log_path, generations or [], world.people(), episode.goal_xy)
        if video is not None and (task.video == "all" or not outcome.success or outcome.collided):
            video.keep()
        if flight is not None:
            flight.settle(task.flights, outcome, task.folder)
        count = None if generations is None else len(generations)
        return episode_result(
            task, outcome, log, generations=count, stopped_by=str(notes.get("stopped_by", "")), started_ns=started_ns
        )


def _video(task: EpisodeTask) -> EpisodeVideo:
    from sim_hil.benchmark.results.video import EpisodeVideo  # here: fonts and drawing are only needed for this

    return EpisodeVideo(task.video_path, task.episode, task.instruction)


def _realtime(task: EpisodeTask, on_time: OnTime) -> EpisodeResult:
    from sim_hil.benchmark.workers.realtime_episode import run_realtime  # here: it needs nothing of what lockstep does

    return run_realtime(task, on_time)


RUNNERS: Mapping[str, Callable[[EpisodeTask, OnTime], EpisodeResult]] = {
    "lockstep": run_lockstep,
    "realtime": _realtime,
}
"""Function that runs an episode, by clock; all return the same record."""


def run_episode(task: EpisodeTask, on_time: OnTime = lambda _: None) -> EpisodeResult:
    """Run one episode on its clock. Raises ConditionsError, ArtifactError, ExternalError, SceneError or OSError."""
    runner = RUNNERS.get(task.conditions.clock)
    if runner is None:
        raise ConditionsError(f"--clock {task.conditions.clock}: not in this version; expected {', '.join(RUNNERS)}")
    return runner(task, on_time)
