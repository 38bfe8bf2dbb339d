"""Pages: values from outside are printed as inert text; cells are marks, links and notes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from reporting.page import Cell, Table, render, text_html
from tests.support.html_page import HtmlPage


def demo_page(**changed: object) -> str:
    table = Table(("", "name"), [])
    values: dict[str, object] = {
        "title": "a page", "passed": True, "verdict": "", "instruction": "", "robot": "", "scene": "", "people": 0,
        "seed": 0, "duration_s": 1.0, "untrained": False, "tiles": [], "maps": [], "cards": [], "histograms": [],
        "time_line": {"png": b"", "alt": "", "caption": "", "wide": False}, "checks": table, "numbers": table,
        "machine": None, "events": None,
    }  # fmt: skip
    return render("demo", **{**values, **changed})


def tags_of(page: str) -> list[str]:
    return [tag for tag, _ in HtmlPage(page).tags]


@given(st.text(st.characters(), max_size=200))
def test_any_text_is_one_inert_run_of_characters(text: str) -> None:
    escaped = text_html(text)
    assert tags_of(f"<pre>{escaped}</pre>") == ["pre"]
    escaped.encode("utf-8")


def test_long_text_is_cut_at_a_limit_that_the_page_names() -> None:
    assert text_html("x" * 1000, limit=10) == "xxxxxxxxxx … (1000 characters in all)"


def test_no_value_of_a_template_adds_a_tag() -> None:
    evil = '"><script>alert(1)</script>\u202e'
    rows = [[evil, Cell(evil, "pass", note=evil)], [Cell(evil, link=evil), Cell(evil, "code")]]
    card = {"jpeg": None, "generation": 1, "meta": evil, "text": evil}
    page = demo_page(
        title=evil,
        robot=evil,
        instruction=evil,
        scene=evil,
        tiles=[(evil, evil)],
        checks=Table((evil, evil), rows),
        cards=[card],
    )
    assert "script" not in tags_of(page) and "\u202e" not in page
    assert "⟨U+202E⟩" in page


def test_cells_are_links_marks_and_notes() -> None:
    cells = [Cell("PASS", "pass"), Cell("video", link="videos/a.mp4"), Cell("1.0", note="≤ 2"), Cell("ab12", "code")]
    page = demo_page(checks=Table(("a", "b", "c", "d"), [cells], numeric=frozenset({2}))).replace("\n", "")
    assert '<td><span class="pass">PASS</span></td><td><a href="videos/a.mp4">video</a></td>' in page
    assert '<td class="number">1.0<br><span class="quiet">≤ 2</span></td>' in page
    assert "<code>ab12</code>" in page
