"""HTML pages of reports, rendered from the Jinja2 templates in `templates/`. No script, nothing is loaded.

Text from outside (above all the model's) may contain markup, control characters or characters that turn the writing
direction. Every value that a template prints is therefore escaped, its unprintable characters are shown by number, and
it is cut at 700 characters.
"""

from __future__ import annotations

import base64
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

_SHOWN_CHARACTERS = 700


@dataclass(frozen=True)
class Cell:
    """A table cell with markup: CSS class, link, and a second line in small print."""

    text: str
    style: str = ""
    link: str = ""
    note: str = ""


@dataclass(frozen=True)
class Table:
    """A table; the columns in `numeric` are right-aligned."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    numeric: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Figure:
    """A PNG with its caption; on a phone a wide one is scrolled sideways instead of shrunk."""

    png: bytes
    alt: str
    caption: str
    wide: bool = False


def mark(passed: bool, text: str) -> Cell:
    """Return the cell of a verdict in green or red."""
    return Cell(text, "pass" if passed else "fail")


def text_html(text: str, limit: int = _SHOWN_CHARACTERS) -> Markup:
    """Return untrusted text as inert HTML; unprintable characters are shown by number, not dropped."""
    shown = "".join(_visible(character) for character in text[:limit])
    more = f" … ({len(text)} characters in all)" if len(text) > limit else ""
    return escape(shown + more)


def _visible(character: str) -> str:
    if character == "\n":
        return character
    # Cc control, Cf format (turns writing direction, joins invisibly), Cs half a surrogate pair, Co, Cn: no glyph
    if unicodedata.category(character) in {"Cc", "Cf", "Cs", "Co", "Cn"}:
        return f"⟨U+{ord(character):04X}⟩"
    return character


def image_uri(data: bytes, kind: str = "png") -> Markup:
    """Return the `data:` URI of a picture; `kind` is png, jpeg or gif."""
    return Markup(f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}")


def _finalize(value: object) -> object:
    return value if isinstance(value, Markup) or not isinstance(value, str) else text_html(value)


_TEMPLATES = Environment(
    loader=PackageLoader("reporting"),
    autoescape=True,
    finalize=_finalize,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters.update(upto=text_html, uri=image_uri)


def render(template: str, **values: object) -> str:
    """Return the page of `templates/TEMPLATE.html.j2`, which extends `base.html.j2` and needs a `title`."""
    return _TEMPLATES.get_template(f"{template}.html.j2").render(values)
