"""A padded batch gives every row what `LanguageModel.forward` gives it alone, and learns from answers only."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch

from edge.reasoning.line_constraint import LineConstraint
from export.model.config import PRESETS, TicVlaConfig
from export.model.language import LanguageModel
from export.model.network import build
from tools.train.samples import language_batch
from tools.train.samples.language_batch import Row, collate, decode, row_losses, run

IMAGE = 5
DEVICE = torch.device("cpu")


pytestmark = pytest.mark.usefixtures("one_thread")


def tiny() -> TicVlaConfig:
    """`nano` with narrow layers: 4 visual tokens a frame, merged to 1."""
    nano = PRESETS["nano"]
    vision = dataclasses.replace(nano.vision, image_px=32, hidden=24, layers=1, mlp=32, token_dim=32)
    language = dataclasses.replace(nano.language, hidden=32, layers=3, head_dim=8, mlp=48, vocab=64)
    action = dataclasses.replace(nano.action, hidden=32, layers=1, ffn=32)
    return dataclasses.replace(nano, vision=vision, language=language, action=action)


@pytest.fixture(scope="module")
def language() -> LanguageModel:
    return build(tiny(), 3).language


@pytest.fixture(params=["plain", "torch"])
def attention(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plain products, or torch's attention as on a GPU and for long rows."""
    if request.param == "torch":
        monkeypatch.setattr(language_batch, "PLAIN_TOKENS", 0)


def row(seed: int, frames: int, text: int, answer: int) -> Row:
    rng = np.random.default_rng(seed)
    prompt: list[int] = []
    for _ in range(frames):
        prompt += [*rng.integers(6, 64, text), IMAGE]
    pictures = rng.standard_normal((frames, 4, 32)).astype(np.float16)
    return Row((*prompt, 7), tuple(rng.integers(6, 64, answer)), tuple(pictures))


ROWS = [row(1, 4, 5, 9), row(2, 1, 3, 4), row(3, 2, 1, 1), row(4, 3, 2, 0)]


def alone(language: LanguageModel, one: Row, upto: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits after `upto` tokens and K‖V [upto, kv_dim] of one row through `LanguageModel.forward`."""
    past = [torch.zeros(1, 2, 0, 8)] * (2 * language.config.layers)
    pictures = torch.from_numpy(np.stack(one.frames)).float()
    with torch.no_grad():
        _, logits, kv, *_ = language(torch.tensor([one.fed[:upto]]), pictures, past)
    return logits[-1], kv[0]


@pytest.mark.usefixtures("attention")
def test_keys_values_and_scores_of_every_row_are_those_of_the_row_alone(language: LanguageModel) -> None:
    batch = collate(ROWS, img_context_id=IMAGE, device=DEVICE)
    with torch.no_grad():
        kv = run(language, batch.input_ids, batch.visual_tokens, None).last_layer_kv
        hidden = run(language, batch.input_ids, batch.visual_tokens, batch.query_at).hidden
        logits = language.lm_head(hidden)
    for i, one in enumerate(ROWS):
        torch.testing.assert_close(kv[i, : batch.lengths[i]], alone(language, one, len(one.fed))[1], atol=1e-5, rtol=0)
        for j in range(max(1, len(one.answer))):
            expected = alone(language, one, len(one.prompt) + j)[0]
            torch.testing.assert_close(logits[i, j], expected, atol=1e-5, rtol=0)


def test_the_loss_of_a_row_is_the_mean_over_its_answer_whatever_stands_beside_it(language: LanguageModel) -> None:
    with torch.no_grad():
        together = row_losses(language, collate(ROWS, img_context_id=IMAGE, device=DEVICE))
    for i, one in enumerate(ROWS[:3]):
        terms = [
            torch.log_softmax(alone(language, one, len(one.prompt) + j)[0], -1)[token]
            for j, token in enumerate(one.answer)
        ]
        assert together[i].item() == pytest.approx(-float(torch.stack(terms).mean()), abs=1e-5)
    assert together[3].item() == 0.0


def test_gradients_are_those_of_torchs_own_attention(language: LanguageModel, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[list[torch.Tensor]] = []
    for longest in (language_batch.PLAIN_TOKENS, 0):
        monkeypatch.setattr(language_batch, "PLAIN_TOKENS", longest)
        language.zero_grad()
        row_losses(language, collate(ROWS, img_context_id=IMAGE, device=DEVICE)).sum().backward()
        found.append([weight.grad.clone() for weight in language.parameters() if weight.grad is not None])
    torch.testing.assert_close(found[0], found[1], atol=1e-6, rtol=1e-3)


def test_gradients_reach_the_merge_layer_through_the_answers_alone(language: LanguageModel) -> None:
    silent = [dataclasses.replace(one, answer=()) for one in ROWS]
    for rows, learns in ((ROWS, True), (silent, False)):
        language.zero_grad()
        row_losses(language, collate(rows, img_context_id=IMAGE, device=DEVICE)).sum().backward()
        moved = [bool(p.grad is not None and p.grad.abs().sum() > 0) for p in language.merge.parameters()]
        assert any(moved) is learns
    language.zero_grad()


@pytest.mark.usefixtures("attention")
@pytest.mark.parametrize("most", [0, 1, 6])
def test_greedy_answers_of_a_batch_are_those_of_every_row_alone(language: LanguageModel, most: int) -> None:
    silent = [dataclasses.replace(one, answer=()) for one in ROWS]
    said = decode(language, collate(silent, img_context_id=IMAGE, device=DEVICE), most)
    for one, row_said in zip(silent, said, strict=True):
        ids: list[int] = []
        while len(ids) < most:
            spoken = Row((*one.prompt, *ids), (), one.frames)
            chosen = int(alone(language, spoken, len(spoken.fed))[0].argmax())
            if chosen == language.config.im_end_id:
                break
            ids.append(chosen)
        assert row_said.ids == tuple(ids)
        spoken = Row((*one.prompt, *ids), (), one.frames)
        torch.testing.assert_close(
            row_said.last_layer_kv, alone(language, spoken, len(spoken.fed))[1], atol=1e-5, rtol=0
        )


def test_a_row_follows_its_constraint_and_receives_the_constrained_tokens(language: LanguageModel) -> None:
    silent = [dataclasses.replace(one, answer=()) for one in ROWS[:2]]
    batch = collate(silent, img_context_id=IMAGE, device=DEVICE)
    free = decode(language, batch, 6)
    head, *_ = free[0].ids
    other = next(i for i in range(20, 40) if i not in free[0].ids)
    said = decode(language, batch, 6, [LineConstraint([(head, other, head)]), None])
    assert said[0].ids[:3] == (head, other, head) and said[1].ids == free[1].ids
    spoken = Row((*silent[0].prompt, *said[0].ids), (), silent[0].frames)
    torch.testing.assert_close(said[0].last_layer_kv, alone(language, spoken, len(spoken.fed))[1], atol=1e-5, rtol=0)


def test_greedy_decoding_ends_at_the_end_token_and_at_the_models_context(language: LanguageModel) -> None:
    silent = [dataclasses.replace(one, answer=()) for one in ROWS]
    batch = collate(silent, img_context_id=IMAGE, device=DEVICE)
    free = decode(language, batch, 6)
    short = copy.deepcopy(language)
    longest = max(len(one.fed) for one in silent)
    short.config = dataclasses.replace(language.config, max_context=longest + 2)
    for i, said in enumerate(decode(short, batch, 6)):
        assert said.ids == free[i].ids[: longest + 2 - len(silent[i].fed)]
    ends = free[0].ids[2]
    short.config = dataclasses.replace(language.config, im_end_id=ends)
    for i, said in enumerate(decode(short, batch, 6)):
        upto = free[i].ids.index(ends) if ends in free[i].ids else 6
        assert said.ids == free[i].ids[:upto]
