"""The policies that imitation trains: the action expert, or the paper's point-goal baseline."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from export.model.action import ActionExpert
from tools.train.config.imitate import LossConfig
from tools.train.imitate.point_goal_net import PointGoalNet
from tools.train.samples import action_batch
from tools.train.samples.action_batch import ActionBatch
from tools.train.samples.drive_frames import DriveFrames
from tools.train.scenes.walls import too_near


def plan_loss(config: LossConfig, plan: Tensor, batch: ActionBatch) -> Tensor:
    """Compute the loss [B] of plans [B, steps, 3]: equation 4, plus a penalty for plans too close to walls."""
    loss = action_batch.smooth_l1(plan, batch, beta=config.beta, heading_weight=config.heading_weight)
    if not config.walls or batch.around is None:
        return loss
    return loss + config.walls * too_near(plan.float(), batch.target, batch.known, *batch.around, config.room_m)


class TrainablePolicy(ABC):
    """A policy that is trained on batches."""

    module: nn.Module
    """The trained network; all of its parameters are trained."""
    uses_semantics: bool
    """Whether the policy receives semantic states."""

    @abstractmethod
    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute trajectories [B, steps, 3]."""

    @abstractmethod
    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute the loss of every frame [B]."""

    @abstractmethod
    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Prepare for training on these drives, once before the first step."""


class ActionExpertPolicy(TrainablePolicy):
    """The action expert with any of its heads."""

    uses_semantics = True

    def __init__(self, action: ActionExpert, loss: LossConfig) -> None:
        self.module = self._action = action.eval()
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute the plan with the batch's dropout masks."""
        return action_batch.plan(self._action, batch)

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute equation 4 and the wall penalty, or the objective of a diffusion or flow head (paper appendix D)."""
        if self._action.config.action.head == "query":
            return plan_loss(self._loss, self.plan(batch), batch)
        return action_batch.errors(self._action, batch, generator)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Compute mean and deviation of the labels for heads that normalise actions."""
        if self._action.scale is None:
            return
        labels = [(torch.from_numpy(drive.target), torch.from_numpy(drive.known)) for drive in drives]
        target = torch.cat([each for each, _ in labels])
        known = torch.cat([each for _, each in labels])[:, None] > torch.arange(target.shape[1])
        device = next(self._action.parameters()).device
        self._action.fit_actions(target.to(device), known.to(device))


class PointGoalNetPolicy(TrainablePolicy):
    """The point-goal network for behaviour cloning, with the action expert's state dropout."""

    uses_semantics = False

    def __init__(self, network: PointGoalNet, loss: LossConfig) -> None:
        self.module = self._network = network
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute the plan from image, state and goal."""
        plans: Tensor = self._network(batch.visual_tokens, batch.state * batch.keep_state[:, None], batch.goal)
        return plans

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute equation 4 and the wall penalty."""
        return plan_loss(self._loss, self.plan(batch), batch)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Do nothing."""
