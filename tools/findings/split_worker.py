"""Worker process that drives one scenario in several variants, one after the other, and writes one file for each."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import tools.findings
import tools.train
from edge.artifacts.files import ArtifactError
from edge.core.cli import write_whole
from edge.reasoning.prompt import InstructionError
from edge.state.switches import SwitchOptions
from export.core.typed import build
from sim_hil.benchmark.conditions.conditions import Conditions, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.policies.policy import Policy
from sim_hil.benchmark.policies.select import open_policy, robot_config
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import EPISODES, StoreError
from sim_hil.benchmark.workers.code_version import code_sha256
from sim_hil.benchmark.workers.run_episode import drive
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.processes.child_process import Message
from sim_hil.scene.table import SceneError
from tools.findings.split_policies import VARIANTS, SplitPolicy
from tools.train.drives.scenarios import KEPT_SEEDS, Scenario, training_episodes

MODULE: Final = "tools.findings.split_worker"
SCENARIO_SEED: Final = KEPT_SEEDS[0]
KINDS: Final[Mapping[str, float]] = {"hospital": 1.0, "office": 1.0, "warehouse": 1.0}
"""Shares of the layouts: those of the benchmark's buildings."""
EXPERT: Final = "expert"


@dataclass(frozen=True)
class SplitJob:
    """Scenario `number` to be driven in `variants`; results go into `folder`/VARIANT/NUMBER.json.

    `manifest_sha256`, `code`: artifacts and code that began the run; with others the job is refused.
    """

    folder: str
    artifacts: str
    latency_s: float
    number: int
    variants: tuple[str, ...]
    manifest_sha256: str
    code: str


def scenario_of(number: int) -> Scenario:
    """Return a scenario of a kept seed, on which nothing is trained; each has a layout of its own."""
    return next(iter(training_episodes(SCENARIO_SEED, 1, KINDS, start=number, tasks_per_scene=1)))


def code() -> str:
    """Return the SHA-256 of all code that computes a result: simulation, robot, and what writes the true texts."""
    return code_sha256(tools.findings, tools.train)


def result_path(folder: Path, variant: str, number: int) -> Path:
    """Return the file of one episode's result."""
    return folder / variant / f"{number:04d}.json"


def messages(job: Message) -> Iterator[Mapping[str, Any]]:
    """Drive a job; yield `{"done": variant, "success": …}`, or `{"failed": variant, "why": …}`, after each variant.

    Raises StoreError if the code is not that of the run.
    """
    order = build(SplitJob, job, "job")
    if code() != order.code:
        raise StoreError("the code has changed since the run began; name another directory")
    scenario = scenario_of(order.number)
    for name in order.variants:
        try:
            result = run_variant(order, scenario, name)
        except (InstructionError, SceneError, ValueError) as error:  # the later variants do not need this one
            yield {"failed": name, "why": str(error)}
            continue
        path = result_path(Path(order.folder), name, order.number)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(result.as_json()) + "\n")
        yield {"done": name, "success": result.success, "wall_s": result.wall_s}


def run_variant(order: SplitJob, scenario: Scenario, name: str) -> EpisodeResult:
    """Drive one variant. Raises ArtifactError, InstructionError, SceneError."""
    started_ns, variant = time.monotonic_ns(), VARIANTS[name]
    episode = scenario.episode if variant.people else replace(scenario.episode, people=0)
    folder = Path(order.folder) / "logs" / name
    (folder / EPISODES).mkdir(parents=True, exist_ok=True)
    if name == EXPERT:
        conditions = Conditions(PolicySpec(EXPERT))
    else:
        latency = LatencyProfile.constant(order.latency_s)
        spec = PolicySpec("artifacts", order.artifacts)
        conditions = Conditions(spec, mode="async", latency=latency, drift=variant.drift)
    with closing(_policy(order, conditions, scenario, name)) as policy:
        task = EpisodeTask(episode, conditions, folder)
        return drive(task, policy, lambda _: None, started_ns=started_ns, scene=scenario.scene)


def _policy(order: SplitJob, conditions: Conditions, scenario: Scenario, name: str) -> Policy:
    if name == EXPERT or conditions.latency is None:
        return open_policy(conditions)
    policy = SplitPolicy(
        Path(conditions.policy.where), mode="async", latency=conditions.latency, robot=robot_config(),
        switches=SwitchOptions(decoding=VARIANTS[name].decoding),
    )  # fmt: skip
    if policy.manifest_sha256 != order.manifest_sha256:
        raise ArtifactError(f"{order.artifacts}: expected the artifacts that began the run; name another directory")
    policy.begin(VARIANTS[name], scenario)
    return policy


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {MODULE}", messages))
