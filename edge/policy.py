"""The fast half of the model: shared encoder, semantic context, action expert."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from edge.geometry import SE2
from edge.graph import Graph
from edge.manifest import Artifacts
from edge.semantic import Context, SemanticState

FloatArray = npt.NDArray[np.float32]


def fit_frame(rgb: npt.NDArray[np.uint8], image_px: int) -> npt.NDArray[np.uint8]:
    """Camera image [h, w, 3] → the encoder's [1, px, px, 3]; the whole field of view, as InternVL's single tile."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"expected a uint8 image [h, w, 3], found {rgb.dtype}{list(rgb.shape)}")
    shrinks = rgb.shape[0] > image_px
    resized = cv2.resize(rgb, (image_px, image_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return cast(npt.NDArray[np.uint8], resized[None])


class Policy:
    """π of equation 1, in the three calls that run at different rates."""

    def __init__(self, artifacts: Artifacts, *, threads: int | None = None, provider: str | None = None) -> None:
        def graph(name: str) -> Graph:
            return Graph(artifacts, name, threads=threads, provider=provider)

        self._vision, self._action, self._context = (
            graph(name) for name in ("vision_encoder", "action_expert", "semantic_context")
        )

    def encode(self, frame: npt.NDArray[np.uint8]) -> FloatArray:
        """Frame [1, px, px, 3] → visual tokens [1, N, D] (every new frame, control thread)."""
        return cast(FloatArray, self._vision.run({"frame": frame})[0])

    def semantic_context(self, last_layer_kv: FloatArray) -> Context:
        """K‖V [1, T, kv_dim] → keys and values for every layer (once a generation, reasoning thread)."""
        return dict(zip(self._context.output_names, self._context.run({"last_layer_kv": last_layer_kv}), strict=True))

    def act(
        self,
        visual_tokens: FloatArray,
        state: tuple[float, float, float],
        delay_s: float,
        offset: SE2,
        semantic: SemanticState,
    ) -> FloatArray:
        """Planned trajectory [steps, 3] in the current robot frame (every tick, control thread)."""
        feeds = {
            "visual_tokens": visual_tokens,
            "state": np.array([state], dtype=np.float32),
            "latency": np.array([[delay_s, offset.x_m, offset.y_m, offset.theta_rad]], dtype=np.float32),
            **semantic.context,
        }
        return cast(FloatArray, self._action.run(feeds)[0][0])
