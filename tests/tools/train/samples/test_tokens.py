"""Tokens on disk are what the encoder makes of a drive's pictures, and belong to that encoder and that drive alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch

from edge.state.frame import fit_frame
from export.graphs.build import write_graph
from export.model.network import TicVla, build
from export.quantize.precision import Precision
from tests.support.train.train_drives import made_up_drive, tiny_model, write_dataset
from tools.train.config.checks import TrainError
from tools.train.drives.drive import Dataset, Drive
from tools.train.run.job import QuietProgress
from tools.train.samples.tokens import TokenCache, encode

FRAMES = 7


def pictured(drive_id: str, seed: int, frames: int = FRAMES) -> Drive:
    """A drive whose pictures all differ."""
    rng = np.random.default_rng(seed)
    jpegs = []
    for _ in range(frames):
        coarse = rng.integers(0, 256, (8, 8, 3), np.uint8)
        picture = cv2.resize(coarse, (128, 128), interpolation=cv2.INTER_NEAREST)
        jpegs.append(cv2.imencode(".jpg", picture)[1].reshape(-1))
    ends = np.cumsum([len(jpeg) for jpeg in jpegs]).astype(np.int64)
    plain = made_up_drive(drive_id, frames)
    return dataclasses.replace(plain, jpeg=np.concatenate(jpegs), jpeg_end=ends)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return write_dataset(tmp_path / "collect", [pictured("a", 1), pictured("b", 2, 3)])


@pytest.fixture(scope="module")
def network() -> TicVla:
    return build(tiny_model(), 1)


def test_tokens_are_the_encoders_output_for_every_picture(dataset: Dataset, network: TicVla) -> None:
    cache = TokenCache(dataset, network.vision)
    assert cache.build(batch=3) == 2
    drive = dataset.load("a")
    tokens = cache.frames("a")
    assert tokens.dtype == np.float16 and tokens.shape == (FRAMES, 4, 32)
    for k in range(FRAMES):
        with torch.no_grad():
            alone = network.vision(torch.from_numpy(fit_frame(drive.frame(k), 32)))[0].numpy()
        np.testing.assert_allclose(tokens[k], alone, rtol=2e-3, atol=2e-3)
    assert not np.array_equal(tokens[0], tokens[1])


def test_only_what_is_missing_is_encoded(dataset: Dataset, network: TicVla) -> None:
    cache = TokenCache(dataset, network.vision)
    assert cache.build(["b"]) == 1 and cache.missing() == ("a",)
    stamp = (cache.folder / "b.npy").stat().st_mtime_ns
    assert cache.build() == 1 and cache.missing() == () and cache.build() == 0
    assert (cache.folder / "b.npy").stat().st_mtime_ns == stamp


def test_another_encoder_has_a_folder_of_its_own(dataset: Dataset, network: TicVla) -> None:
    cache = TokenCache(dataset, network.vision)
    cache.build()
    other = TokenCache(dataset, build(tiny_model(), 2).vision)
    assert other.folder != cache.folder and other.missing() == ("a", "b")
    again = TokenCache(dataset, build(tiny_model(), 1).vision)
    assert again.key == cache.key and again.missing() == ()


def test_a_drive_that_was_recorded_again_is_encoded_again(tmp_path: Path, dataset: Dataset, network: TicVla) -> None:
    TokenCache(dataset, network.vision).build()
    before = TokenCache(dataset, network.vision).frames("a")[:].copy()
    (tmp_path / "collect" / "index.jsonl").unlink()
    changed = write_dataset(tmp_path / "collect", [pictured("a", 9), pictured("b", 2, 3)])
    cache = TokenCache(changed, network.vision)
    assert cache.missing() == ("a",)
    cache.build()
    assert not np.array_equal(cache.frames("a"), before)


def test_a_build_that_was_ended_goes_on_with_the_next_drive(dataset: Dataset, network: TicVla) -> None:
    class EndAfterOne(QuietProgress):
        def update(self, done: int, total: int, **numbers: float) -> None:
            raise KeyboardInterrupt

    cache = TokenCache(dataset, network.vision)
    with pytest.raises(KeyboardInterrupt):
        cache.build(progress=EndAfterOne())
    assert cache.missing() == ("b",)
    assert cache.build() == 1


def test_an_array_of_another_shape_is_refused_with_what_to_do(dataset: Dataset, network: TicVla) -> None:
    cache = TokenCache(dataset, network.vision)
    cache.build()
    np.save(cache.folder / "a.npy", np.zeros((2, 4, 32), np.float16))
    with pytest.raises(TrainError, match="delete it"):
        cache.frames("a")


def test_tokens_that_half_precision_cannot_hold_are_refused(dataset: Dataset) -> None:
    wild = build(tiny_model(), 1)
    with torch.no_grad():
        wild.vision.projector[3].weight *= 1e6
    with pytest.raises(TrainError, match="float16"):
        TokenCache(dataset, wild.vision).build()


def test_an_exported_graph_makes_the_same_tokens_but_for_rounding(tmp_path: Path, network: TicVla) -> None:
    write_graph(network, "vision_encoder", Precision("fp32"), "plain", tmp_path)
    session = onnxruntime.InferenceSession(str(tmp_path / "vision_encoder.onnx"), providers=["CPUExecutionProvider"])
    pictures = np.random.default_rng(3).integers(0, 256, (4, 32, 32, 3), np.uint8)
    cached = encode(network.vision, pictures)
    for k in range(4):
        (exported,) = session.run(None, {"frame": pictures[k : k + 1]})
        np.testing.assert_allclose(cached[k], exported[0], rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("torn", ["a.npy", "a.json"])
def test_half_of_a_pair_of_files_does_not_count(dataset: Dataset, network: TicVla, torn: str) -> None:
    cache = TokenCache(dataset, network.vision)
    cache.build()
    (cache.folder / torn).unlink()
    assert cache.missing() == ("a",)
