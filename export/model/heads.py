"""The two generative heads of the paper's comparison (appendix D, Table 11): diffusion and normalising flow.

Both work on actions normalised by each step's mean and deviation over the data set, stored with the weights. An
*action* is integrated into the trajectory: an increment (dx m, dy m, dθ rad), or, with the parameterisation `offsets`,
a position and an increment of the heading.

Inference starts from `noise`, a buffer stored with the weights; the paper draws new noise instead. So a plan is a
function of its inputs, a graph written again has the same bytes, and ticks do not alternate between two equal routes.

* Diffusion: one Gaussian sample of the weights' seed, because the denoiser was trained on noisy inputs only.
* Flow: zero, the mode of the base distribution, which the couplings map to the centre of the learned distribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor, nn

from export.model.attention import CrossAttentionLayer, KeyValue, TypedModuleList, projection
from export.model.config import ActionConfig

MIN_STD = 1e-3
"""Smallest deviation used as divisor, 1 mm or 1 mrad a step: smaller variation is not worth learning."""
MAX_BETA = 0.999
COSINE_OFFSET = 0.008
"""Offset s of the cosine schedule (Nichol and Dhariwal 2021, equation 17)."""
TIME_PERIOD = 1e4
MAX_LOG_SCALE = 2.0
"""Bound on a coupling's log scale: nearly constant data would make the likelihood grow without limit."""


def drawn(
    kind: Callable[..., Tensor], shape: tuple[int, ...], device: torch.device, generator: torch.Generator | None
) -> Tensor:
    """Draw `torch.rand` or `torch.randn` of a shape with a generator on any device, else with torch's own."""
    place = device if generator is None else generator.device
    return kind(shape, generator=generator, device=place).to(device)


def integrated(actions: Tensor, parameterisation: str) -> Tensor:
    """Integrate actions [B, steps, 3] to a trajectory [B, steps, 3] (x m, y m, θ rad) in the current robot frame."""
    if parameterisation == "increments":
        return torch.cumsum(actions, dim=1)
    return torch.cat([actions[..., :2], torch.cumsum(actions[..., 2:], dim=1)], dim=-1)


def differentiated(trajectory: Tensor, parameterisation: str) -> Tensor:
    """Invert `integrated`; headings may be wrapped, their increments are within ±π."""
    steps = torch.diff(trajectory, dim=1, prepend=torch.zeros_like(trajectory[:, :1]))
    position = steps[..., :2] if parameterisation == "increments" else trajectory[..., :2]
    return torch.cat([position, wrapped(steps[..., 2:])], dim=-1)


def wrapped(angle: Tensor) -> Tensor:
    """Wrap angles to −π…π, rad."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


class ActionScale(nn.Module):
    """Mean and deviation of every step's action, [1, steps, 3], stored with the weights."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: ActionConfig) -> None:
        super().__init__()
        self._start = config.initial_step
        self.register_buffer("mean", torch.zeros(1, config.steps, 3))
        self.register_buffer("std", torch.ones(1, config.steps, 3))

    def start(self) -> None:
        """Initialise to a slow walk straight ahead, as the query head does."""
        self.mean.copy_(torch.tensor(self._start).expand_as(self.mean))
        self.std.fill_(1.0)

    def fit(self, actions: Tensor, known: Tensor | None = None) -> None:
        """Compute mean and deviation of a data set's actions [N, steps, 3], valid where `known` [N, steps]."""
        weight = torch.ones_like(actions[..., :1]) if known is None else known[..., None]
        weight = weight.double()
        count = weight.sum(dim=0, keepdim=True)
        if not (count > 0).all() or not torch.isfinite(actions).all():
            raise ValueError(f"actions {list(actions.shape)}: expected finite ones, at least one known for every step")
        mean = (actions.double() * weight).sum(dim=0, keepdim=True) / count
        variance = ((actions.double() - mean).square() * weight).sum(dim=0, keepdim=True) / count
        with torch.no_grad():
            self.mean.copy_(mean)
            self.std.copy_(variance.sqrt().clamp(min=MIN_STD))

    def normalised(self, actions: Tensor) -> Tensor:
        """Normalise actions to mean 0 and deviation 1 at every step."""
        return (actions.float() - self.mean) / self.std

    def forward(self, normalised: Tensor) -> Tensor:
        """Invert `normalised`; returns actions in m and rad."""
        return normalised.float() * self.std + self.mean


@lru_cache
def cosine_schedule(levels: int) -> tuple[float, ...]:
    """Return the clean signal's share of power at each noise level, least noise first (paper: cosine schedule)."""

    def left(level: int) -> float:
        return math.cos((level / levels + COSINE_OFFSET) / (1 + COSINE_OFFSET) * math.pi / 2) ** 2

    shares, share = [], 1.0
    for level in range(levels):
        share *= 1 - min(1 - left(level + 1) / left(level), MAX_BETA)
        shares.append(share)
    return tuple(shares)


@lru_cache
def ddim_steps(levels: int, count: int) -> tuple[tuple[int, float, float], ...]:
    """Return `count` deterministic DDIM steps (noise level, a, b) of x ← a·x + b·(predicted clean actions).

    Levels are evenly spaced from the noisiest; the last step returns the prediction (a 0, b 1).
    """
    shares = cosine_schedule(levels)
    times = [round(levels * i / count) - 1 for i in range(count, 0, -1)]
    steps = []
    for time, following in zip(times, [*times[1:], None], strict=True):
        left = 1.0 if following is None else shares[following]
        a = math.sqrt((1 - left) / (1 - shares[time]))
        steps.append((time, a, math.sqrt(left) - a * math.sqrt(shares[time])))
    return tuple(steps)


def time_embedding(times: Tensor, width: int) -> Tensor:
    """Embed noise levels [B] as sines and cosines [B, width] of wavelengths up to 2π·TIME_PERIOD."""
    rates = TIME_PERIOD ** (-torch.arange(width // 2, device=times.device, dtype=torch.float32) / (width // 2))
    angles = times.float()[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Diffusion(nn.Module):
    """Diffusion head: embeds noisy actions and noise level as tokens, and samples by DDIM.

    The denoiser is the expert's transformer; its learned queries are the tokens' positions.
    """

    noise: Tensor

    def __init__(self, config: ActionConfig) -> None:
        super().__init__()
        self.config = config
        self.action_in = nn.Linear(3, config.hidden)
        self.time_projection = projection(config.hidden, config.hidden)
        self.register_buffer("noise", torch.zeros(1, config.steps, 3))

    def start(self, generator: torch.Generator) -> None:
        """Draw the noise from which every chunk is denoised."""
        self.noise.normal_(generator=generator)

    def time_tokens(self, times: Tensor) -> Tensor:
        """Embed noise levels [B] as a summand of every token, [B, 1, hidden]."""
        tokens: Tensor = self.time_projection(time_embedding(times, self.config.hidden))
        return tokens[:, None]

    def tokens(self, noisy: Tensor, times: Tensor, positions: Tensor) -> Tensor:
        """Embed noisy normalised actions [B, steps, 3] at levels [B] as tokens [B, steps, hidden]."""
        tokens: Tensor = self.action_in(noisy) + positions + self.time_tokens(times)
        return tokens

    def corrupted(self, clean: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Add noise to clean normalised actions at uniformly drawn levels; returns the noisy actions and levels [B]."""
        levels = self.config.diffusion_steps
        times = (drawn(torch.rand, clean.shape[:1], clean.device, generator) * levels).long().clamp(max=levels - 1)
        share = torch.tensor(cosine_schedule(levels), device=clean.device)[times][:, None, None]
        noise = drawn(torch.randn, tuple(clean.shape), clean.device, generator)
        return share.sqrt() * clean + (1 - share).sqrt() * noise, times

    def sample(self, denoise: Callable[[Tensor, Tensor], Tensor], batch: int) -> Tensor:
        """Sample normalised actions [batch, steps, 3] with `denoise`: (noisy actions, levels) → clean actions."""
        x = self.noise.expand(batch, -1, -1)
        for time, a, b in ddim_steps(self.config.diffusion_steps, self.config.ddim_steps):
            x = a * x + b * denoise(x, torch.full((batch,), time, device=x.device)).float()
        return x


class Coupling(nn.Module):
    """Affine map of half of a chunk's steps, conditioned on the other half and on the expert's features."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.action_in = nn.Linear(3, hidden)
        self.key_value = KeyValue(hidden, heads)
        self.layer = CrossAttentionLayer(hidden, heads, hidden)
        self.norm = nn.LayerNorm(hidden)
        self.out = nn.Linear(hidden, 6)

    def forward(self, given: Tensor, given_features: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Compute log scale and shift, [B, S, 3] each, of the steps with `features` [B, S, hidden].

        `given` [B, G, 3]: the other steps' actions; `given_features`: their features.
        """
        x = self.layer(features, *self.key_value(given_features + self.action_in(given)))
        log_scale, shift = self.out(self.norm(x)).float().chunk(2, dim=-1)
        return MAX_LOG_SCALE * torch.tanh(log_scale / MAX_LOG_SCALE), shift


class Flow(nn.Module):
    """Normalising flow of couplings that map even and odd steps alternately (even steps first and last of five).

    Neighbouring steps are strongly correlated, which a coupling can use.
    """

    noise: Tensor

    def __init__(self, config: ActionConfig) -> None:
        super().__init__()
        self.couplings = TypedModuleList(Coupling(config.hidden, config.heads) for _ in range(config.couplings))
        self.register_buffer("noise", torch.zeros(1, config.steps, 3))

    def start(self) -> None:
        """Set the noise to the mode of the base distribution."""
        self.noise.zero_()

    def sample(self, features: Tensor) -> Tensor:
        """Map features [B, steps, hidden] to normalised actions [B, steps, 3]."""
        halves, seen = halved(self.noise.expand(len(features), -1, -1)), halved(features)
        for index, coupling in enumerate(self.couplings):
            moved, given = index % 2, 1 - index % 2
            log_scale, shift = coupling(halves[given], seen[given], seen[moved])
            halves[moved] = halves[moved] * log_scale.exp() + shift
        return woven(halves)

    def surprise(self, actions: Tensor, features: Tensor) -> Tensor:
        """Compute −log p of normalised actions [B, steps, 3] as one term per number; a chunk's −log p is their sum."""
        halves, seen = halved(actions), halved(features)
        scales = [torch.zeros_like(half) for half in halves]
        for index in reversed(range(len(self.couplings))):
            moved, given = index % 2, 1 - index % 2
            log_scale, shift = self.couplings[index](halves[given], seen[given], seen[moved])
            halves[moved] = (halves[moved] - shift) * torch.exp(-log_scale)
            scales[moved] = scales[moved] + log_scale
        terms = [0.5 * z.square() + scale for z, scale in zip(halves, scales, strict=True)]
        return woven(terms) + 0.5 * math.log(2 * math.pi)


def halved(x: Tensor) -> list[Tensor]:
    """Split [B, steps, …] into even and odd steps."""
    return [x[:, 0::2], x[:, 1::2]]


def woven(halves: list[Tensor]) -> Tensor:
    """Invert `halved`."""
    return torch.cat(halves, dim=1)[:, weave(sum(half.shape[1] for half in halves))]


def weave(steps: int) -> list[int]:
    """Return each step's index in the sequence of even steps followed by odd ones."""
    return [step // 2 + (steps + 1) // 2 * (step % 2) for step in range(steps)]
