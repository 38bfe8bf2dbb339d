"""What imitation trains: the action expert, or the point-goal network that the paper compares it with."""

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
    """Of every frame's plan [B, steps, 3]: equation 4, and what it comes too near to walls."""
    loss = action_batch.smooth_l1(plan, batch, beta=config.beta, heading_weight=config.heading_weight)
    if not config.walls or batch.around is None:
        return loss
    return loss + config.walls * too_near(plan.float(), batch.target, batch.known, *batch.around, config.room_m)


class Pupil(ABC):
    """A policy that learns from batches."""

    module: nn.Module
    """What learns: all of its parameters."""
    hears: bool
    """Whether it is given semantic states."""

    @abstractmethod
    def plan(self, batch: ActionBatch) -> Tensor:
        """Trajectories [B, steps, 3]."""

    @abstractmethod
    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """What is made small, for every frame [B]."""

    @abstractmethod
    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Look at all drives once before the first step."""


class ExpertPupil(Pupil):
    """The action expert, by any of its heads."""

    hears = True

    def __init__(self, action: ActionExpert, loss: LossConfig) -> None:
        self.module = self._action = action.eval()
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """By the network's layers, with what the batch drops out."""
        return action_batch.plan(self._action, batch)

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Equation 4 and walls; a diffusion's or a flow's own objective (paper appendix D)."""
        if self._action.config.action.head == "query":
            return plan_loss(self._loss, self.plan(batch), batch)
        return action_batch.errors(self._action, batch, generator)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Heads that work on normalised actions take mean and deviation from the labels."""
        if self._action.scale is None:
            return
        labels = [(torch.from_numpy(drive.target), torch.from_numpy(drive.known)) for drive in drives]
        target = torch.cat([each for each, _ in labels])
        known = torch.cat([each for _, each in labels])[:, None] > torch.arange(target.shape[1])
        device = next(self._action.parameters()).device
        self._action.fit_actions(target.to(device), known.to(device))


class PointGoalPupil(Pupil):
    """Behaviour cloning of the paper's point-goal baseline; the state is dropped out as the action expert's is."""

    hears = False

    def __init__(self, network: PointGoalNet, loss: LossConfig) -> None:
        self.module = self._network = network
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """From picture, state and goal alone."""
        plans: Tensor = self._network(batch.visual_tokens, batch.state * batch.keep_state[:, None], batch.goal)
        return plans

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Equation 4 and walls."""
        return plan_loss(self._loss, self.plan(batch), batch)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """There is nothing to be looked at."""
