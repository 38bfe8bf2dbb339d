"""Broken, hostile and incomplete checkpoints: refused in one line, and nothing in them is run or followed outwards."""

from __future__ import annotations

import json
import os
import pickle  # noqa: TID251 - planted in files to be refused, never loaded
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from export.checkpoint.load import load_checkpoint
from tests.support.export.internvl import CONFIG, refusal, write_directory


def header(fields: object, data: bytes = b"") -> bytes:
    text = fields if isinstance(fields, bytes) else json.dumps(fields).encode()
    return struct.pack("<Q", len(text)) + text + data


F32 = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
BAD_FILES: dict[str, bytes] = {
    "empty": b"",
    "short": b"\x08",
    "text": b"not a checkpoint at all, but long enough to hold a header",
    "huge header": struct.pack("<Q", 1 << 62) + b"{}",
    "header beyond the file": struct.pack("<Q", 500) + b"{}",
    "header is a list": header([]),
    "header is deep": header(b"[" * 200_000),
    "not utf-8": header(b'{"\xff": 1}'),
    "no shape": header({"a": {"dtype": "F32"}}, bytes(8)),
    "entry is text": header({"a": "F32"}, bytes(8)),
    "truncated": header({"a": F32}, bytes(7)),
    "bytes left over": header({"a": F32}, bytes(9)),
    "overlap": header({"a": F32, "b": F32}, bytes(16)),
    "hole": header({"a": {**F32, "data_offsets": [8, 16]}}, bytes(16)),
    "shape beyond the data": header({"a": {**F32, "shape": [1 << 60]}}, bytes(8)),
    "negative shape": header({"a": {**F32, "shape": [-2, -1]}}, bytes(8)),
    "true as a size": header({"a": {**F32, "shape": [True, 2]}}, bytes(8)),
    "unknown type": header({"a": {**F32, "dtype": "F13"}}, bytes(8)),
    "one name twice": header(b'{"a":%b,"a":%b}' % ((json.dumps(F32).encode(),) * 2), bytes(8)),
    "metadata is a number": header({"__metadata__": {"config": 3}, "a": F32}, bytes(8)),
    "nothing inside": header({}),
    "pickle": pickle.dumps({"a": 1}),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_file_that_is_not_safetensors_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bad.safetensors"
    path.write_bytes(BAD_FILES[kind])
    assert refusal(path).startswith("bad.safetensors: ")


class Evil:
    """Runs a command where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.mark,)


@pytest.mark.parametrize("suffix", [".ckpt", ".pt", ".bin"])
@pytest.mark.parametrize("saved", ["torch", "plain pickle", "old torch"])
def test_code_in_a_checkpoint_is_refused_and_never_run(tmp_path: Path, suffix: str, saved: str) -> None:
    path, mark = tmp_path / f"evil{suffix}", tmp_path / "ran"
    content = {"state_dict": {"a": torch.zeros(1)}, "callbacks": Evil(mark)}
    if saved == "plain pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=saved == "torch")
    assert "code in a checkpoint is never run" in refusal(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    "content",
    [
        {"state_dict": {"vision.cls": 3}},
        {"state_dict": {}},
        {"state_dict": {3: torch.zeros(1)}},
        [torch.zeros(1)],
        torch.zeros(1),
        {"epoch": 1},
    ],
    ids=str,
)
def test_a_torch_file_without_a_state_dict_is_refused(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "odd.ckpt")
    assert refusal(tmp_path / "odd.ckpt").startswith("odd.ckpt: ")


def test_a_truncated_torch_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.ckpt"
    torch.save({"state_dict": {"vision.cls": torch.zeros(10_000)}}, path)
    path.write_bytes(path.read_bytes()[:-5_000])
    assert refusal(path).startswith("cut.ckpt: ")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused(original: dict[str, Tensor], tmp_path: Path, value: float) -> None:
    bad = original["mlp1.1.weight"].clone()
    bad[1, 1] = value
    path = write_directory(tmp_path / "vlm", original | {"mlp1.1.weight": bad})
    assert "mlp1.1.weight: has values that are not finite" in refusal(path)


@pytest.mark.parametrize("dtype", [torch.float64, torch.int8, torch.bool])
@pytest.mark.parametrize("kind", ["safetensors", "ckpt"])
def test_other_number_types_are_refused(
    original: dict[str, Tensor], tmp_path: Path, dtype: torch.dtype, kind: str
) -> None:
    tensors = original | {"mlp1.0.bias": original["mlp1.0.bias"].to(dtype)}
    path = tmp_path / "vlm.ckpt"
    if kind == "safetensors":
        path = write_directory(tmp_path / "vlm", tensors)
    else:
        torch.save(tensors, path)
    assert "mlp1.0.bias is " in refusal(path)


@pytest.mark.parametrize(
    "shard", ["../../x", "/etc/passwd", "..", "", "a/b.safetensors", "link.safetensors", "a\0b", "\ud800", "\x1b[2J"]
)
def test_a_shard_outside_the_directory_is_refused(vlm: Path, tmp_path: Path, shard: str) -> None:
    (vlm / "model.safetensors").rename(tmp_path / "x")
    (vlm / "link.safetensors").symlink_to(tmp_path / "x")
    index = {"weight_map": {"mlp1.0.bias": shard}}
    (vlm / "model.safetensors.index.json").write_text(json.dumps(index), encoding="utf-8")
    line = refusal(vlm)
    assert "not a file name of this directory" in line or "leads out of the directory" in line


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_link_out_of_the_directory_is_refused(vlm: Path, tmp_path: Path, name: str) -> None:
    (vlm / name).rename(tmp_path / "elsewhere")
    (vlm / name).symlink_to(tmp_path / "elsewhere")
    assert "a link that leads out of the directory" in refusal(vlm)


def test_a_loop_of_links_is_no_file(vlm: Path) -> None:
    config = vlm / "config.json"
    config.unlink()
    config.symlink_to("config.json")
    assert "config.json: no such file" in refusal(vlm)


@pytest.mark.slow
def test_a_header_of_a_million_tensors_of_one_name_is_refused_at_once(tmp_path: Path) -> None:
    names = [f'"{number}":0' for number in range(300_000)]
    path = tmp_path / "bad.safetensors"
    path.write_bytes(header(b"{%b}" % ",".join([*names, names[-1]]).encode()))
    begun_ns = time.monotonic_ns()
    assert "299999 occurs twice" in refusal(path)
    assert time.monotonic_ns() - begun_ns < 5_000_000_000  # a comparison of all pairs takes minutes


def test_the_links_of_the_hub_cache_are_followed(vlm: Path, tmp_path: Path) -> None:
    snapshot = tmp_path / "models--x" / "snapshots" / "abc"
    blobs = tmp_path / "models--x" / "blobs"
    snapshot.mkdir(parents=True)
    blobs.mkdir()
    for file in vlm.iterdir():
        file.rename(blobs / file.name)
        (snapshot / file.name).symlink_to(Path("../../blobs") / file.name)
    assert load_checkpoint([snapshot], CONFIG, fill_seed=0).coverage.complete


@pytest.mark.parametrize("damage", ["absent shard", "moved tensor", "absent tensor", "tensor in two", "not json"])
def test_a_wrong_index_is_refused(vlm: Path, original: dict[str, Tensor], damage: str) -> None:
    names = list(original)
    halves = {"a.safetensors": names[:20], "b.safetensors": names[20:]}
    weight_map = {name: file for file, inside in halves.items() for name in inside}
    if damage == "absent shard":
        weight_map["more"] = "c.safetensors"
    elif damage == "absent tensor":
        weight_map["more"] = "b.safetensors"
    elif damage == "moved tensor":
        weight_map[names[0]] = "b.safetensors"
    elif damage == "tensor in two":
        halves["a.safetensors"].append(names[-1])
    for file, inside in halves.items():
        save_file({name: original[name] for name in inside}, str(vlm / file))
    text = "{" if damage == "not json" else json.dumps({"weight_map": weight_map})
    (vlm / "model.safetensors.index.json").write_text(text, encoding="utf-8")
    assert refusal(vlm)


def test_an_empty_directory_is_refused_with_the_expected_files(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "has neither model.safetensors nor model.safetensors.index.json" in refusal(tmp_path / "empty")


@pytest.mark.parametrize("name", ["absent.safetensors", "weights.onnx", "fifo.safetensors"])
def test_a_file_that_is_no_checkpoint_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "weights.onnx").write_bytes(b"x")
    os.mkfifo(tmp_path / "fifo.safetensors")
    assert refusal(tmp_path / name)
