"""From the conditions of a run to a policy that drives, and to what the world has to render for it.

Each kind of policy is imported when it is asked for: an episode has a process of its own, and one that drives by itself
need not wait for ONNX Runtime.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import firmware_bridge
from edge.artifacts.files import ArtifactError
from firmware_bridge.core.config import RobotConfig, load_robot_config
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.policies.baselines import make_baseline
from sim_hil.benchmark.policies.policy import Policy

if TYPE_CHECKING:
    from edge.artifacts.manifest import Artifacts

ROBOT_FILE: Final = Path(firmware_bridge.__file__).parent / "robots" / "go2_sim.toml"
"""Its limits hold for both robots, so that a policy is compared on them under the same ones."""
BASELINE_CAMERA: Final = (128, 128)


def robot_config() -> RobotConfig:
    """The limits and ages that hold on board."""
    return load_robot_config(ROBOT_FILE)


def open_policy(conditions: Conditions, manifest_sha256: str = "") -> Policy:
    """A policy ready for `reset`; with a hash, artifacts must be those. Raises ArtifactError, ExternalError, …"""
    kind = conditions.policy.kind
    if kind == "artifacts":
        return _artifacts(conditions, manifest_sha256)
    if kind == "point-goal-net":
        from sim_hil.benchmark.policies.point_goal_net import PointGoalNetPolicy

        return PointGoalNetPolicy(Path(conditions.policy.where), robot_config())
    return _external(conditions) if kind == "external" else make_baseline(kind)


def _artifacts(conditions: Conditions, manifest_sha256: str) -> Policy:
    from sim_hil.benchmark.conditions.variants import artifact_directory
    from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy

    if conditions.mode is None or conditions.latency is None:
        raise ConditionsError("a policy from artifacts needs a mode and a latency in lockstep")
    directory = artifact_directory(Path(conditions.policy.where), conditions.variant)
    policy = ArtifactsPolicy(
        directory, mode=conditions.mode, latency=conditions.latency, robot=robot_config(), switches=conditions.switches
    )
    if manifest_sha256 and policy.manifest_sha256 != manifest_sha256:
        raise ArtifactError(f"{directory}: not the artifacts that this run was started with; copy them to this machine")
    return policy


def _external(conditions: Conditions) -> Policy:
    from sim_hil.benchmark.policies.external import ExternalPolicy
    from sim_hil.benchmark.policies.external_protocol import Address

    address, timeout_s = Address.parse(conditions.policy.where), conditions.external_timeout_s
    return ExternalPolicy(address, robot_config().limits, timeout_s=timeout_s, latency=conditions.latency)


def camera_for(conditions: Conditions, policy: Policy) -> tuple[int, int] | None:
    """(width, height) that the world renders; None: nothing. Raises ConditionsError if the policy needs another."""
    asked, own = conditions.camera_size, getattr(policy, "camera", BASELINE_CAMERA if policy.needs_image else None)
    if asked is not None and own is not None and asked != own:
        raise ConditionsError(f"camera {conditions.camera}: {policy.name} looks at {own[0]}x{own[1]}; leave it at auto")
    return asked or own


def check_artifacts(conditions: Conditions) -> Artifacts | None:
    """Verify the artifacts of a run before any episode; None without any. Raises ArtifactError, ConditionsError."""
    if conditions.policy.kind != "artifacts":
        return None
    from edge.artifacts.manifest import load_artifacts
    from sim_hil.benchmark.conditions.variants import artifact_directory, check_variant
    from sim_hil.benchmark.policies.artifacts_policy import check_suits

    directory = artifact_directory(Path(conditions.policy.where), conditions.variant)
    artifacts = load_artifacts(directory)
    check_suits(artifacts, conditions.mode or "async")
    check_variant(artifacts, conditions.variant)
    return artifacts
