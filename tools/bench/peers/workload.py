"""Workload of every contender: shapes of a frame, a prompt and a control step, with seeded inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from export.model.config import PRESETS, TicVlaConfig

FRAMES = 4
TEXT_TOKENS = 76
"""Prompt: four frames and 76 tokens of text make the paper's 1,100 tokens at full size."""
DECODE_STEPS = 80
"""Tokens of an answer; those of `answers.json` have 72 to 93 at full size."""
SEED = 0


@dataclass(frozen=True)
class Workload:
    """Shapes of one model's benchmark."""

    model: str

    def __post_init__(self) -> None:
        if self.model not in PRESETS:
            raise ValueError(f"model {self.model!r} is not known; expected one of: {', '.join(sorted(PRESETS))}")

    @property
    def config(self) -> TicVlaConfig:
        """The network's configuration."""
        return PRESETS[self.model]

    @property
    def prompt_tokens(self) -> int:
        """Tokens of the prefill."""
        return FRAMES * self.config.frame_tokens + TEXT_TOKENS

    @property
    def semantic_tokens(self) -> int:
        """Tokens of the semantic state that the action expert reads: prompt and decoded tokens."""
        return self.prompt_tokens + DECODE_STEPS

    def frame(self, index: int = 0) -> npt.NDArray[np.uint8]:
        """Build a frame [1, px, px, 3] of smooth gradients with noise; pure noise has untypical activations."""
        px = self.config.vision.image_px
        rng = np.random.default_rng([SEED, index])
        corners = rng.uniform(0, 255, (2, 2, 3))
        y, x = np.mgrid[0:px, 0:px][..., None] / px
        smooth = (1 - y) * ((1 - x) * corners[0, 0] + x * corners[0, 1])
        smooth = smooth + y * ((1 - x) * corners[1, 0] + x * corners[1, 1])
        noisy = smooth + rng.normal(0, 12, (px, px, 3))
        frame: npt.NDArray[np.uint8] = np.clip(noisy, 0, 255).astype(np.uint8)
        return frame[None]

    def text_ids(self, count: int) -> npt.NDArray[np.int64]:
        """Return `count` ids of ordinary text tokens."""
        c = self.config.language
        special = (c.im_start_id, c.im_end_id, c.img_start_id, c.img_end_id, c.img_context_id)
        low, high = (0, min(special)) if min(special) > c.vocab // 2 else (max(special) + 1, c.vocab)
        return np.random.default_rng(SEED).integers(low, high, count).astype(np.int64)

    def last_layer_kv(self) -> npt.NDArray[np.float32]:
        """Build a semantic state [1, T, kv_dim]."""
        shape = (1, self.semantic_tokens, self.config.kv_dim)
        return np.random.default_rng(SEED + 1).standard_normal(shape).astype(np.float32)

    def action_inputs(self) -> dict[str, npt.NDArray[np.float32]]:
        """Build the inputs of the unsplit action expert in order; latency is Δt, Δx, Δy, Δθ."""
        shape = (1, self.config.vision.tokens, self.config.vision.token_dim)
        return {
            "visual_tokens": np.random.default_rng(2).standard_normal(shape).astype(np.float32),
            "state": np.array([[0.4, 0.0, 0.0]], dtype=np.float32),
            "latency": np.array([[2.0, 0.0, 0.0, 0.0]], dtype=np.float32),
            "last_layer_kv": self.last_layer_kv(),
        }
