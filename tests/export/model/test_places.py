"""Codes of places: as large as tokens nearly, unlike for places that are apart, alike for neighbours."""

from __future__ import annotations

import pytest
import torch

from export.model.config import PRESETS
from export.model.network import PLACE_RMS, build, grid_codes, line_codes


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


def test_a_pictures_codes_tell_row_and_column() -> None:
    codes = grid_codes(64, 192).unflatten(0, (8, 8))
    assert torch.equal(codes[2, 1, :96], codes[2, 7, :96]) and torch.equal(codes[1, 5, 96:], codes[6, 5, 96:])
    assert not torch.allclose(codes[2, 1], codes[1, 2])
    with pytest.raises(ValueError, match="square"):
        grid_codes(65, 192)


def test_a_new_network_knows_its_places() -> None:
    model = build(PRESETS["nano"], 1)
    action = model.action
    places = (action.visual_position, action.semantic_position, action.metadata_position)
    for position in (model.vision.position[0, 1:], *places):
        assert float(position.detach().square().mean().sqrt()) == pytest.approx(PLACE_RMS, rel=0.1)


def test_the_last_semantic_token_has_the_same_code_in_a_longer_context() -> None:
    semantic = build(PRESETS["nano"], 1).action.semantic_position[0].detach()
    torch.testing.assert_close(semantic[-1], line_codes(*semantic.shape)[0], atol=0.1, rtol=0)
