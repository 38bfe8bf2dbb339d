"""Pages: values from outside are printed as inert text; cells are marks, links and notes."""

from __future__ import annotations

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from reporting.page import Cell, Table, render, text_html


def demo_page(**changed: object) -> str:
    table = Table(("", "name"), [])
    values: dict[str, object] = {
        "title": "a page", "passed": True, "verdict": "", "instruction": "", "scene": "", "people": 0, "seed": 0,
        "duration_s": 1.0, "untrained": False, "tiles": [], "maps": [], "cards": [], "histograms": [],
        "time_line": {"png": b"", "alt": "", "caption": "", "wide": False}, "checks": table, "numbers": table,
        "machine": None,
    }  # fmt: skip
    return render("demo", **{**values, **changed})


class _Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)


@given(st.text(st.characters(), max_size=200))
def test_any_text_is_one_inert_run_of_characters(text: str) -> None:
    escaped = text_html(text)
    assert _Tags(f"<pre>{escaped}</pre>").tags == ["pre"]
    escaped.encode("utf-8")


def test_long_text_is_cut_at_a_limit_that_the_page_names() -> None:
    assert text_html("x" * 1000, limit=10) == "xxxxxxxxxx … (1000 characters in all)"


def test_no_value_of_a_template_adds_a_tag() -> None:
    evil = '"><script>alert(1)</script>\u202e'
    rows = [[evil, Cell(evil, "pass", note=evil)], [Cell(evil, link=evil), Cell(evil, "code")]]
    card = {"jpeg": None, "generation": 1, "meta": evil, "text": evil}
    page = demo_page(
        title=evil, instruction=evil, scene=evil, tiles=[(evil, evil)], checks=Table((evil, evil), rows), cards=[card]
    )
    assert "script" not in _Tags(page).tags and "\u202e" not in page
    assert "⟨U+202E⟩" in page


def test_cells_are_links_marks_and_notes() -> None:
    cells = [Cell("PASS", "pass"), Cell("video", link="videos/a.mp4"), Cell("1.0", note="≤ 2"), Cell("ab12", "code")]
    page = demo_page(checks=Table(("a", "b", "c", "d"), [cells], numeric=frozenset({2}))).replace("\n", "")
    assert '<td><span class="pass">PASS</span></td><td><a href="videos/a.mp4">video</a></td>' in page
    assert '<td class="number">1.0<br><span class="quiet">≤ 2</span></td>' in page
    assert "<code>ab12</code>" in page
