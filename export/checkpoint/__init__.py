"""Reading other people's checkpoints (and ours) into the network, with every tensor accounted for."""

from export.checkpoint.coverage import CheckpointError, Coverage, SourceCoverage
from export.checkpoint.hf_config import config_from_hf
from export.checkpoint.load import LoadedCheckpoint, load_checkpoint
from export.checkpoint.tokenizer import tokenizer_for

__all__ = [
    "CheckpointError",
    "Coverage",
    "LoadedCheckpoint",
    "SourceCoverage",
    "config_from_hf",
    "load_checkpoint",
    "tokenizer_for",
]
