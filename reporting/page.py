"""The few pieces of HTML reports are made of. One page, no script, nothing loaded from anywhere.

Text from outside (above all the VLM's) goes through `text_html`: it may hold markup, control characters or
characters that turn the writing direction, and none of these may act on the page.
"""

from __future__ import annotations

import base64
import html
import unicodedata
from collections.abc import Iterable, Sequence

STYLE = """
:root { --ink: #1d2733; --muted: #5b6774; --line: #dfe4e9; --card: #ffffff; --good: #1d7a43; --bad: #b3261e; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7f9; color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1160px; margin: 0 auto; padding: 24px 20px 64px; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 8px 0 4px; }
h2 { font-size: 1.2rem; margin: 40px 0 8px; }
p { margin: 6px 0; max-width: 78ch; }
.quiet { color: var(--muted); }
.notice { background: #fff6df; border-left: 4px solid #d9a514; padding: 10px 14px; margin: 16px 0; max-width: none; }
.verdict { display: inline-block; padding: 4px 12px; border-radius: 999px; color: #fff; font-weight: 600; }
.verdict.good { background: var(--good); } .verdict.bad { background: var(--bad); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(165px, 1fr)); gap: 12px; margin: 16px 0; }
.tile, figure { background: var(--card); border: 1px solid var(--line); border-radius: 10px; }
.tile { padding: 12px 14px; }
.tile b { display: block; font-size: 1.5rem; line-height: 1.25; font-variant-numeric: tabular-nums; }
.tile span { color: var(--muted); font-size: 0.85rem; }
figure { margin: 12px 0; padding: 10px; }
figure img { display: block; width: 100%; height: auto; }
figcaption { color: var(--muted); font-size: 0.88rem; margin-top: 6px; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 12px; }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(255px, 1fr)); gap: 12px; }
.sheet figure { margin: 0; display: flex; flex-direction: column; }
.sheet img { border-radius: 6px; }
.sheet .meta { font-size: 0.82rem; color: var(--muted); margin: 8px 0 4px; font-variant-numeric: tabular-nums; }
.vlm { font: 0.82rem/1.4 ui-monospace, Menlo, Consolas, monospace; background: #f2f4f6; border-radius: 6px;
  padding: 8px; margin: 0; white-space: pre-wrap; overflow-wrap: anywhere; unicode-bidi: isolate; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; background: var(--card); font-size: 0.92rem; }
th, td { text-align: left; padding: 7px 10px; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; background: #eef1f4; }
th.number { text-align: right; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.pass { color: var(--good); font-weight: 600; } .fail { color: var(--bad); font-weight: 600; }
@media (max-width: 640px) {
  .wide { overflow-x: auto; } .wide img { width: 860px; max-width: none; }
  .sheet { grid-template-columns: repeat(auto-fill, minmax(180px, 1fr)); }
}
@media print {
  .sheet { grid-template-columns: repeat(4, 1fr); } .tiles { grid-template-columns: repeat(6, 1fr); }
  .pair { grid-template-columns: 1fr 1fr; }
  body { background: #fff; font-size: 11pt; } main { max-width: none; padding: 0; }
  figure, .tile, tr { break-inside: avoid; } h2 { break-after: avoid; }
  .verdict, .vlm, th, .notice { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""

_SHOWN_CHARACTERS = 700


def text_html(text: str, *, limit: int = _SHOWN_CHARACTERS) -> str:
    """Untrusted text as inert HTML; what cannot be printed is shown by its number, not dropped."""
    shown = "".join(_visible(character) for character in text[:limit])
    more = f" … ({len(text)} characters in all)" if len(text) > limit else ""
    return html.escape(shown, quote=True) + more


def _visible(character: str) -> str:
    if character == "\n":
        return character
    # Cc control, Cf format (turns writing direction, joins invisibly), Cs half a surrogate pair, Co, Cn: no glyph
    if unicodedata.category(character) in {"Cc", "Cf", "Cs", "Co", "Cn"}:
        return f"⟨U+{ord(character):04X}⟩"
    return character


def image_uri(data: bytes, kind: str) -> str:
    """`data:` URI of a picture; kind is png or jpeg."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def figure(data: bytes, alt: str, caption: str, *, wide: bool = False) -> str:
    """A PNG with its caption (both plain text); a wide one is scrolled sideways on a phone instead of shrunk."""
    kind = ' class="wide"' if wide else ""
    uri = image_uri(data, "png")
    return (
        f'<figure{kind}><img src="{uri}" alt="{html.escape(alt)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def tiles(items: Iterable[tuple[str, str]]) -> str:
    """Headline numbers: (value, what it is)."""
    cells = "".join(f'<div class="tile"><b>{text_html(v)}</b><span>{text_html(what)}</span></div>' for v, what in items)
    return f'<div class="tiles">{cells}</div>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric: frozenset[int] = frozenset()) -> str:
    """A table; cells are HTML already. Columns in `numeric` are set right-aligned."""
    lines = ['<div class="scroll"><table><thead><tr>']
    marks = [' class="number"' if i in numeric else "" for i in range(len(head))]
    lines += [f"<th{mark}>{html.escape(cell)}</th>" for mark, cell in zip(marks, head, strict=True)]
    lines.append("</tr></thead><tbody>")
    for row in rows:
        cells = (f'<td class="number">{c}</td>' if i in numeric else f"<td>{c}</td>" for i, c in enumerate(row))
        lines.append(f"<tr>{''.join(cells)}</tr>")
    lines.append("</tbody></table></div>")
    return "".join(lines)


def document(title: str, body: str) -> str:
    """The whole page. The policy forbids scripts and every load, so even a mistake in escaping stays inert."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">"
        f"<title>{text_html(title)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )
