"""One generation's work: a result that is not finite fails, and the next generation computes its whole prompt again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from edge.artifacts.manifest import Artifacts
from edge.inference.calls import Call, Chunk, Floats
from edge.inference.generation_task import GenerationModels, GenerationTask, NotFiniteError
from edge.inference.language import LanguageModel
from tests.edge.inference.test_language import SENTENCE, frames


def test_a_generation_after_one_that_was_not_finite_reuses_none_of_its_rows(artifacts: Artifacts) -> None:
    language = LanguageModel(artifacts, threads=1)
    policy: Any = SimpleNamespace(semantic_context=lambda _kv, _interrupt: {})
    job: Any = SimpleNamespace(instruction=SENTENCE)
    task = GenerationTask(GenerationModels(language, policy), job, 2)
    task.anchor = frames(1, 64, 256)[0]
    sound = language.prefill_call

    def damaged(chunk: Chunk, past: int, kv: Floats, interrupt: Any) -> list[int]:
        chosen = sound(chunk, past, kv, interrupt)
        kv[:, past] = np.nan
        return chosen

    language.prefill_call = cast("Call", damaged)
    with pytest.raises(NotFiniteError):
        task.finish(language.begin(lambda: False))
    language.prefill_call = sound
    result = task.finish(language.begin(lambda: False))
    assert np.isfinite(result.generation.last_layer_kv).all()
