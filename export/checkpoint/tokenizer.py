"""Selects an artifact directory's tokenizer and checks it against the network's token ids."""

from __future__ import annotations

from pathlib import Path

from tokenizers import Tokenizer

from edge.artifacts.runtime import SPECIAL_TOKENS
from edge.artifacts.tokenizer_file import TokenizerFileError, check_tokenizer_file
from export.checkpoint.sources import inside
from export.model.config import PRESETS, LanguageConfig, TicVlaConfig
from export.model.tokenizers.internvl import TokenizerError, build_tokenizer
from export.model.tokenizers.nano import NANO_TOKENIZER
from export.model.weights import CheckpointError

TOKENIZER = "tokenizer.json"
MAX_TOKENIZER_BYTES = 64 << 20


def special_ids(language: LanguageConfig) -> dict[str, int]:
    """Return special token → the network's id of it."""
    return {token: getattr(language, name) for name, token in SPECIAL_TOKENS.items()}


def check_tokenizer(content: bytes, language: LanguageConfig, label: str) -> bytes:
    """Return `content` if its special tokens have the network's ids and none is too large. Raises CheckpointError."""
    try:
        check_tokenizer_file(content, special_ids(language))
        tokenizer = Tokenizer.from_buffer(content)
    except TokenizerFileError as error:
        raise CheckpointError(f"{label}: {error}") from error
    except Exception as error:  # the library raises plain Exception for a file it cannot read
        raise CheckpointError(f"{label}: not a tokenizer ({' '.join(str(error).split())[:160]})") from error
    for token, wanted in special_ids(language).items():
        found = tokenizer.token_to_id(token)
        if found != wanted:
            raise CheckpointError(f"{label}: {token} is id {found}, the network was built for {wanted}")
    highest = max(tokenizer.get_vocab().values())
    if highest >= language.vocab:
        raise CheckpointError(f"{label}: has id {highest}, the network's vocabulary ends at {language.vocab - 1}")
    return content


def directory_tokenizer(directory: Path, language: LanguageConfig) -> bytes | None:
    """Read and check tokenizer.json of a Hugging Face directory; None without one. Raises CheckpointError."""
    if not (directory / TOKENIZER).exists():
        return None
    path = inside(directory, TOKENIZER)
    if path.stat().st_size > MAX_TOKENIZER_BYTES:
        raise CheckpointError(f"{path}: {path.stat().st_size} bytes, expected at most {MAX_TOKENIZER_BYTES}")
    return check_tokenizer(path.read_bytes(), language, f"{directory.resolve().name}/{TOKENIZER}")


def tokenizer_for(config: TicVlaConfig, own: bytes | None) -> bytes:
    """Return the artifacts' tokenizer.json: the checkpoint's `own`, else the built-in one with the network's ids.

    Raises CheckpointError when the ids are neither InternVL3's nor those of preset `nano`.
    """
    if own is not None:
        return own
    ids = special_ids(config.language)
    if ids == special_ids(PRESETS["nano"].language):
        return check_tokenizer(NANO_TOKENIZER.read_bytes(), config.language, NANO_TOKENIZER.name)
    if ids == special_ids(PRESETS["1b"].language):
        try:
            return check_tokenizer(build_tokenizer(), config.language, "InternVL3's tokenizer")
        except TokenizerError as error:
            raise CheckpointError(str(error)) from error
    raise CheckpointError(f"no tokenizer for token ids {ids}; give the checkpoint's directory with its {TOKENIZER}")
