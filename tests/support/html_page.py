"""A parsed HTML page and the check that it loads nothing from elsewhere."""

from __future__ import annotations

from html.parser import HTMLParser


class HtmlPage(HTMLParser):
    """The tags and the text pieces of one page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.pieces: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.pieces.append(data)


def assert_loads_nothing(html: str) -> None:
    for tag, attributes in HtmlPage(html).tags:
        assert tag not in {"script", "link", "iframe", "object", "embed", "base", "use"}
        assert not {"href", "srcset", "onload"} & set(attributes)
        assert str(attributes.get("src", "data:image/")).startswith("data:image/")
    assert "url(" not in html and "@import" not in html
