"""The network: shapes of the design, exact splits, causality, and a cache that changes nothing."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from export.model.config import PRESETS, ModelConfigError, TicVlaConfig
from export.model.network import PLACE_RMS, TicVla, build, grid_codes, initialise, line_codes
from export.model.vision import fold_tokens, pixel_shuffle_v2
from export.model.weights import weights_sha256

NANO = PRESETS["nano"]


@pytest.fixture(scope="module")
def model() -> TicVla:
    return build(NANO, 0)


def frame(seed: int, px: int = 128) -> Tensor:
    return torch.randint(0, 256, (1, px, px, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def no_past(config: TicVlaConfig) -> list[Tensor]:
    c = config.language
    return [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]


def prompt(length: int, images: int = 0) -> Tensor:
    ids = torch.randint(6, NANO.language.vocab, (1, length), generator=torch.Generator().manual_seed(length))
    ids[0, 2 : 2 + 16 * images] = NANO.language.img_context_id
    return ids


def act(model: TicVla, kv: Tensor, latency: list[float], seed: int = 1) -> Tensor:
    keys, values = model.action.context(kv)
    tokens = model.vision(frame(seed))
    return model.action(tokens, torch.zeros(1, 3), torch.tensor([latency]), keys, values)


@pytest.mark.slow
def test_the_paper_preset_is_the_same_code_with_other_numbers() -> None:
    with torch.device("meta"):
        big = TicVla(PRESETS["1b"])
        count = {n: sum(p.numel() for p in getattr(big, n).parameters()) for n in ("vision", "language")}
        shapes = big.vision(torch.zeros(1, 448, 448, 3, dtype=torch.uint8)).shape
    # InternVL3-1B: 304.0 M + 4.48 M vision and projector, 357.9 M decoder and two embeddings of 135.9 M.
    assert count["vision"] == pytest.approx(308.5e6, rel=0.002)
    assert count["language"] == pytest.approx(629.7e6, rel=0.002)
    assert shapes == (1, 256, 896)


@pytest.mark.parametrize("index", range(4))
def test_each_number_of_the_latency_metadata_reaches_the_plan(model: TicVla, index: int) -> None:
    kv = torch.randn(1, 20, NANO.kv_dim)
    latency = [1.0, 0.2, 0.1, 0.1]
    changed = list(latency)
    changed[index] += 1.0
    with torch.no_grad():
        assert not torch.equal(act(model, kv, latency), act(model, kv, changed))


def variant(**fields: object) -> TicVla:
    return build(dataclasses.replace(NANO, action=dataclasses.replace(NANO.action, **fields)), 0)


@pytest.mark.slow
def test_without_latency_awareness_the_metadata_changes_nothing() -> None:
    kv = torch.randn(1, 20, NANO.kv_dim)
    with torch.no_grad():
        model = variant(latency_aware=False)
        assert torch.equal(act(model, kv, [0.0, 0.0, 0.0, 0.0]), act(model, kv, [5.0, 1.0, 1.0, 1.0]))


@pytest.mark.slow
def test_without_motion_offset_only_the_time_counts() -> None:
    kv = torch.randn(1, 20, NANO.kv_dim)
    with torch.no_grad():
        model = variant(motion_offset=False)
        assert torch.equal(act(model, kv, [2.0, 0.0, 0.0, 0.0]), act(model, kv, [2.0, 1.0, 1.0, 1.0]))
        assert not torch.equal(act(model, kv, [2.0, 0.0, 0.0, 0.0]), act(model, kv, [3.0, 0.0, 0.0, 0.0]))


@pytest.mark.slow
def test_values_only_ignores_the_keys() -> None:
    kv = torch.randn(1, 20, NANO.kv_dim)
    other = kv.clone()
    other[..., : NANO.kv_dim // 2] += 1
    with torch.no_grad():
        model = variant(semantic_interface="values-only")
        assert torch.equal(act(model, kv, [1.0, 0, 0, 0]), act(model, other, [1.0, 0, 0, 0]))


def test_the_split_semantic_context_is_exact(model: TicVla) -> None:
    """Cross-attention over [now, semantics] with the semantic half computed apart equals attention over all tokens."""
    kv, state, latency = torch.randn(1, 20, NANO.kv_dim), torch.zeros(1, 3), torch.tensor([[1.0, 0.3, 0.0, 0.1]])
    action = model.action
    with torch.no_grad():
        tokens = model.vision(frame(1))
        split = act(model, kv, [1.0, 0.3, 0.0, 0.1])
        everything = torch.cat([action.now_tokens(tokens, state, latency), action.semantic_tokens(kv)], dim=1)
        x = action.queries
        for key_value, layer in zip(action.key_values, action.layers, strict=True):
            x = layer(x, *key_value(everything))
        whole = torch.cumsum(action.out(action.head(action.norm(x))), dim=1)
    assert torch.allclose(split, whole, atol=1e-6)


def test_a_cache_changes_nothing(model: TicVla) -> None:
    ids, tokens = prompt(40, images=1), model.vision(frame(1)).detach()
    with torch.no_grad():
        whole, _, kv_whole = model.language.hidden_states(ids, tokens, no_past(NANO))
        past, parts, kvs = no_past(NANO), [], []
        for chunk in (ids[:, :25], ids[:, 25:39], ids[:, 39:]):
            x, past, kv = model.language.hidden_states(chunk, tokens, past)
            parts.append(x)
            kvs.append(kv)
    assert torch.allclose(torch.cat(parts, dim=1), whole, atol=1e-4)
    assert torch.allclose(torch.cat(kvs, dim=1), kv_whole, atol=1e-4)


def test_a_token_cannot_see_the_future(model: TicVla) -> None:
    ids, tokens = prompt(30), torch.zeros(1, 64, 256)
    changed = ids.clone()
    changed[0, 20:] = 7
    with torch.no_grad():
        a, _, _ = model.language.hidden_states(ids, tokens, no_past(NANO))
        b, _, _ = model.language.hidden_states(changed, tokens, no_past(NANO))
    assert torch.allclose(a[:, :20], b[:, :20], atol=1e-5)
    assert not torch.allclose(a[:, 20:], b[:, 20:], atol=1e-2)


def test_frames_stand_where_their_places_are_and_in_their_order(model: TicVla) -> None:
    ids = prompt(60, images=2)
    a, b = model.vision(frame(1)).detach(), model.vision(frame(2)).detach()
    with torch.no_grad():
        embedded = model.language.embed_inputs(ids, torch.cat([a, b]))
        merged = model.language.merge(fold_tokens(torch.cat([a, b]), 2)).reshape(-1, 256)
        text = model.language.embed(ids[0])
    assert torch.equal(embedded[0, 2:34], merged)
    assert torch.equal(embedded[0, :2], text[:2])
    assert torch.equal(embedded[0, 34:], text[34:])


def test_pixel_shuffle_puts_a_square_of_cells_into_one() -> None:
    cells = torch.arange(16).reshape(1, 4, 4, 1)
    shuffled = pixel_shuffle_v2(cells, 2)
    assert shuffled.shape == (1, 2, 2, 4)
    assert sorted(shuffled[0, 0, 0].tolist()) == [0, 1, 4, 5]
    assert sorted(shuffled[0, 0, 1].tolist()) == [2, 3, 6, 7]


@pytest.mark.slow
def test_leaving_out_torchs_own_initial_weights_changes_none_of_ours(model: TicVla) -> None:
    twice = TicVla(NANO).eval()
    initialise(twice, 0)
    assert weights_sha256(model) == weights_sha256(twice)


@pytest.mark.slow
def test_one_part_alone_is_filled_without_touching_the_others(model: TicVla) -> None:
    other = build(NANO, 0)
    initialise(other, 1, ("action",))
    a, b = model.state_dict(), other.state_dict()
    assert {name.split(".")[0] for name in a if not torch.equal(a[name], b[name])} == {"action"}


def test_dropout_acts_in_training_only(model: TicVla) -> None:
    kv = torch.randn(1, 200, NANO.kv_dim)
    model.train()
    dropped = model.action.semantic_tokens(kv)
    model.eval()
    kept = model.action.semantic_tokens(kv)
    share = (dropped == 0).all(dim=-1).float().mean()
    assert 0.02 < share < 0.25
    assert not (kept == 0).all(dim=-1).any()


@pytest.mark.parametrize(
    "change",
    [
        {"action": {"hidden": 255}},
        {"action": {"semantic_interface": "telepathy"}},
        {"action": {"parameterisation": "wishes"}},
        {"action": {"kv_dropout": 1.0}},
        {"vision": {"image_px": 100}},
        {"vision": {"stem_channels": (8, 16)}},
        {"language": {"kv_heads": 3}},
        {"language": {"vocab": 4}},
        {"language": {"token_merge": 3}},
    ],
    ids=str,
)
def test_numbers_that_contradict_each_other_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ModelConfigError):
        for section, value in change.items():
            if isinstance(value, dict):
                value = dataclasses.replace(getattr(NANO, section), **value)
            dataclasses.replace(NANO, **{section: value})


@pytest.mark.parametrize(("count", "width"), [(512, 256), (3, 64), (1, 8), (64, 33)])
def test_a_lines_codes_are_of_one_size(count: int, width: int) -> None:
    codes = line_codes(count, width)
    assert codes.shape == (count, width) and codes.dtype == torch.float32
    assert float(codes.square().mean().sqrt()) == pytest.approx(PLACE_RMS, rel=0.2)


def test_neighbours_are_alike_and_no_two_places_are_the_same() -> None:
    codes = torch.nn.functional.normalize(line_codes(512, 256), dim=1)
    alike = codes @ codes.T
    assert float(alike.diagonal(1).min()) > 0.9
    assert float((alike - 2 * torch.eye(512)).max()) < 0.999
    assert float(alike[0, 100:].max()) < 0.8


def test_a_pictures_codes_identify_row_and_column() -> None:
    codes = grid_codes(64, 192).unflatten(0, (8, 8))
    assert torch.equal(codes[2, 1, :96], codes[2, 7, :96]) and torch.equal(codes[1, 5, 96:], codes[6, 5, 96:])
    assert not torch.allclose(codes[2, 1], codes[1, 2])
    with pytest.raises(ValueError, match="square"):
        grid_codes(65, 192)


def test_the_last_semantic_token_has_the_same_code_in_a_longer_context() -> None:
    semantic = build(NANO, 1).action.semantic_position[0].detach()
    torch.testing.assert_close(semantic[-1], line_codes(*semantic.shape)[0], atol=0.1, rtol=0)
