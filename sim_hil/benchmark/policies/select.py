"""Create the policy of a run and determine the image size that the world renders for it.

Policies are imported on demand: every episode has its own process, and a baseline should not wait for ONNX Runtime.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from edge.artifacts.files import ArtifactError
from firmware_bridge.core.config import RobotConfig, load_robot_config
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.policies.baselines import make_baseline
from sim_hil.benchmark.policies.policy import Policy
from sim_hil.realtime.robots import GO2

if TYPE_CHECKING:
    from edge.artifacts.manifest import Artifacts

ROBOT_FILE: Final = GO2.file
"""Robot file whose limits apply to both robots, so that a policy is compared under equal limits."""
BASELINE_CAMERA: Final = (128, 128)


def robot_config() -> RobotConfig:
    """Load the robot file with the limits and maximum ages that the runner applies."""
    return load_robot_config(ROBOT_FILE)


def open_policy(conditions: Conditions, manifest_sha256: str = "") -> Policy:
    """Open the policy of a run; `manifest_sha256` is the expected hash of its artifacts.

    Raises ArtifactError, ConditionsError or ExternalError.
    """
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
        raise ConditionsError("artifacts: expected a mode and a latency in lockstep")
    directory = artifact_directory(Path(conditions.policy.where), conditions.variant)
    policy = ArtifactsPolicy(
        directory, mode=conditions.mode, latency=conditions.latency, robot=robot_config(), switches=conditions.switches
    )
    if manifest_sha256 and policy.manifest_sha256 != manifest_sha256:
        raise ArtifactError(f"{directory}: expected the artifacts that started this run; copy them to this machine")
    return policy


def _external(conditions: Conditions) -> Policy:
    from sim_hil.benchmark.policies.external import ExternalPolicy
    from sim_hil.benchmark.policies.external_protocol import Address

    address, timeout_s = Address.parse(conditions.policy.where), conditions.external_timeout_s
    return ExternalPolicy(address, robot_config().limits, timeout_s=timeout_s, latency=conditions.latency)


def camera_for(conditions: Conditions, policy: Policy) -> tuple[int, int] | None:
    """Return the image size (width, height) to render, px; None: no image.

    Raises ConditionsError if the policy needs another size than the conditions request.
    """
    requested, own = conditions.camera_size, getattr(policy, "camera", BASELINE_CAMERA if policy.needs_image else None)
    if requested is not None and own is not None and requested != own:
        raise ConditionsError(f"camera {conditions.camera}: {policy.name} needs {own[0]}x{own[1]}; leave it at auto")
    return requested or own


def check_artifacts(conditions: Conditions) -> Artifacts | None:
    """Verify the artifacts of a run before any episode and return them; None for another policy.

    Raises ArtifactError or ConditionsError.
    """
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
