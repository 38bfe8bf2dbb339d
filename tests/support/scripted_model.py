"""A language model whose choices a test provides, for tests of the decoding loop."""

from __future__ import annotations

from typing import cast

from edge.inference.calls import Call, Chunk
from edge.inference.language import Generation, LanguageModel
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint


class Script:
    """A call that writes the lines of a text, whatever the earlier ones have become; keeps what it was fed."""

    def __init__(self, lines: list[list[int]], prompt: int) -> None:
        self._lines, self._prompt = lines, prompt
        self._fed: list[int] = []
        self.calls = 0

    def __call__(self, chunk: Chunk, past: int, kv: object, interrupt: object) -> list[int]:
        self.calls += 1
        assert past <= len(self._fed), "every row before the call has been fed"
        self._fed = self._fed[:past]
        chosen: list[int] = []
        for token in chunk.ids:
            self._fed.append(token)
            chosen.append(self._next())
        return chosen

    def _next(self) -> int:
        ends = {line[-1] for line in self._lines[:-1]}
        number, place = 0, 0
        for token in self.answer():
            number, place = (number + 1, 0) if token in ends else (number, place + 1)
        line = self._lines[min(number, len(self._lines) - 1)]
        return line[min(place, len(line) - 1)]

    def answer(self) -> list[int]:
        """Tokens fed behind the prompt."""
        return self._fed[self._prompt :]


def ids_of(language: LanguageModel, text: str) -> list[int]:
    """Return the model's tokens of a text."""
    return list(language.tokenizer.encode(text, add_special_tokens=False).ids)


def decode_script(
    language: LanguageModel, text: str, context: DecodingContext, most: int = 60
) -> tuple[Generation, TextConstraint]:
    """Decode as if the model wrote `text`; return the generation and its constraint."""
    tail = language.prompt.tail((), context.before)
    lines = [ids_of(language, line) for line in text.splitlines(keepends=True)]
    script = Script([*lines[:-1], [*lines[-1], language.runtime.im_end_id]], len(tail.ids))
    language.kept_ids = ()
    language.prefill_call = language.decode_call = cast("Call", script)
    constraint = language.constraint(context)
    made = language.generate([tail], max_new_tokens=most, cancelled=lambda: False, constraint=constraint)
    assert made.last_layer_kv.shape[1] == made.prompt_tokens + made.new_tokens
    assert script.answer()[: made.new_tokens] == list(made.token_ids), "the model is fed what was decoded"
    return made, constraint
