"""Cache of visual tokens of recorded drives, encoded once by the frozen encoder.

A folder belongs to one encoder and is named by the hash of its weights. It contains for each drive `ID.npy` f16
[frames, tokens, width] and `ID.json` with the drive's hash. Both are written atomically, so that an interrupted build
continues with the next drive; of drives that are added later (DAgger), only these are encoded.

Tokens are computed by the torch network in float32 and rounded to float16. An exported graph's tokens differ by this
rounding and by the graph's precision; `tests/tools/train/samples/test_tokens.py` bounds both for a float32 graph.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from edge.core.cli import write_whole
from edge.state.frame import fit_frame
from export.model.vision import VisionEncoder
from tools.train.config.checks import TrainError
from tools.train.drives.drive import Dataset, Drive, Entry
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import QuietProgress, StageProgress

FORMAT: Final = 1
FOLDER: Final = "tokens"
_MAX_OPEN: Final = 256  # open mapped files; a process may have 1024 file descriptors
Halves = NDArray[np.float16]


def tensors_sha256(tensors: Mapping[str, torch.Tensor], head: str = "") -> str:
    """Hash tensors by name, after `head`."""
    digest = hashlib.sha256(head.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name}:{tuple(tensor.shape)}:{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def encoder_sha256(vision: VisionEncoder) -> str:
    """Hash an encoder's configuration and weights; it does not depend on the weights' file."""
    return tensors_sha256(vision.state_dict(), repr(vision.config))


class TokenCache:
    """Tokens of a data set's drives from one encoder, in a folder under `tokens/`."""

    def __init__(self, dataset: Dataset, vision: VisionEncoder, folder: Path | None = None) -> None:
        """Open existing tokens; `build` encodes missing drives. `folder` replaces `tokens/`."""
        self.key = encoder_sha256(vision)
        self.folder = (dataset.folder / FOLDER if folder is None else folder) / self.key[:16]
        self.shape = (vision.config.tokens, vision.config.token_dim)
        """Shape of one frame's tokens."""
        self._dataset, self._vision = dataset, vision
        self._entries = {entry.id: entry for entry in dataset.entries}
        self._open: OrderedDict[str, Halves] = OrderedDict()

    def frames(self, drive_id: str) -> Halves:
        """Return f16 [N, tokens, width] of all frames of a drive, mapped from a file. Raises TrainError."""
        if drive_id not in self._open:
            entry = self._entry(drive_id)
            if not self.has(entry):
                raise TrainError(f"tokens: drive {drive_id} is not encoded yet in {self.folder}; build it first")
            path = self._npy(drive_id)
            try:
                rows: Halves = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise TrainError(f"{path}: not readable ({error}); delete it and build it again") from error
            wanted = (entry.frames, *self.shape)
            if rows.dtype != np.float16 or rows.shape != wanted:
                raise TrainError(f"{path}: expected f16 {wanted}, found {rows.dtype} {rows.shape}; delete it")
            self._open[drive_id] = rows
            if len(self._open) > _MAX_OPEN:
                self._open.popitem(last=False)
        self._open.move_to_end(drive_id)
        return self._open[drive_id]

    def has(self, entry: Entry) -> bool:
        """Return whether the current version of a drive is encoded."""
        try:
            content = json.loads(self._json(entry.id).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        expected = {"format": FORMAT, "drive_sha256": entry.sha256, "encoder_sha256": self.key}
        return bool(content == expected) and self._npy(entry.id).exists()

    def missing(self, ids: Iterable[str] | None = None) -> tuple[str, ...]:
        """Return the drives of the data set (or of `ids`) that are not encoded, sorted."""
        wanted = [self._entry(drive_id) for drive_id in (self._entries if ids is None else ids)]
        return tuple(sorted({entry.id for entry in wanted if not self.has(entry)}))

    def build(
        self,
        ids: Sequence[str] | None = None,
        *,
        device: str = "cpu",
        batch: int = 64,
        ranks: Ranks = SINGLE,
        progress: StageProgress | None = None,
    ) -> int:
        """Encode missing drives (of `ids`), `batch` frames at a time; return how many this rank encoded.

        The encoder is moved to `device` and back. Ranks share the drives; all must call this function. Raises
        TrainError for values beyond float16 or a damaged drive, OSError.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        ranks.barrier()
        missing = self.missing(ids)
        ranks.barrier()  # all ranks have checked before any writes
        own = missing[ranks.rank :: ranks.world]
        before = next(self._vision.parameters()).device
        was_training = self._vision.training
        self._vision.to(device).eval()
        try:
            for done, drive_id in enumerate(own, 1):
                self._write(self._entries[drive_id], self._encoded(self._dataset.load(drive_id), device, batch))
                (progress or QuietProgress()).update(done, len(own))
        finally:
            self._vision.to(before).train(was_training)
        ranks.barrier()
        return len(own)

    def _encoded(self, drive: Drive, device: str, batch: int) -> Halves:
        tokens = np.empty((len(drive), *self.shape), np.float16)
        px = self._vision.config.image_px
        for start in range(0, len(drive), batch):
            chosen = range(start, min(start + batch, len(drive)))
            pictures = np.concatenate([fit_frame(drive.frame(k), px) for k in chosen])
            tokens[start : start + len(chosen)] = encode(self._vision, pictures, device)
        if not np.isfinite(tokens).all():
            raise TrainError(f"drive {drive.id}: tokens exceed float16; train the encoder again")
        return tokens

    def _write(self, entry: Entry, tokens: Halves) -> None:
        path = self._npy(entry.id)
        partial = path.with_name(f"{path.name}.partial")
        # The array first: it is valid only with its JSON file.
        self._json(entry.id).unlink(missing_ok=True)
        with partial.open("wb") as file:
            np.save(file, tokens, allow_pickle=False)
        partial.replace(path)
        made = {"format": FORMAT, "drive_sha256": entry.sha256, "encoder_sha256": self.key}
        write_whole(self._json(entry.id), json.dumps(made, sort_keys=True) + "\n")

    def _entry(self, drive_id: str) -> Entry:
        if drive_id not in self._entries:
            raise TrainError(f"tokens: drive {drive_id} is not in the data set {self._dataset.folder}")
        return self._entries[drive_id]

    def _npy(self, drive_id: str) -> Path:
        return self.folder / f"{drive_id}.npy"

    def _json(self, drive_id: str) -> Path:
        return self.folder / f"{drive_id}.json"


@torch.no_grad()
def encode(vision: VisionEncoder, pictures: NDArray[np.uint8], device: str = "cpu") -> Halves:
    """Encode images uint8 [n, px, px, 3] as f16 [n, tokens, width]; the network is on `device`, in evaluation mode."""
    tokens = vision(torch.from_numpy(pictures).to(device))
    return np.asarray(tokens.to(torch.float16).cpu().numpy(), np.float16)
