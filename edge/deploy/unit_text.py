"""Words of a systemd unit, quoted so that systemd reads back what was meant (systemd.syntax(7), systemd.service(5))."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Setting = tuple[str, str]
"""Key and value of one line; a value may be empty, which resets a list."""


class UnitError(ValueError):
    """Something that cannot be put into a unit; its text is the one line to show."""


def word(text: str) -> str:
    """One word of a list or the program of a command: quotes, backslashes and specifiers (%) are taken literally.

    Raises UnitError for control characters, which not every setting can carry.
    """
    odd = [character for character in text if not character.isprintable()]
    if odd:
        raise UnitError(f"{text!r}: a unit cannot carry the character {odd[0]!r}; expected printable text")
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"'


def argument(text: str) -> str:
    """One argument of a command; unlike in `word`, a dollar sign would otherwise name a variable. Raises UnitError."""
    return word(text).replace("$", "$$")


def bound(path: str) -> str:
    """A path of BindReadOnlyPaths=, where a colon separates; raises UnitError."""
    if ":" in path:
        raise UnitError(f"{path}: a unit cannot show it to the service because of the colon; move it")
    return word(path)


def render(comment: Sequence[str], sections: Mapping[str, Sequence[Setting | str]]) -> str:
    """The text of a unit: `# comment` lines, then each section's settings; a bare string there is a comment."""
    lines = [f"# {line}" for line in comment]
    for section, settings in sections.items():
        lines += ["", f"[{section}]"]
        lines += [f"# {entry}" if isinstance(entry, str) else f"{entry[0]}={entry[1]}" for entry in settings]
    return "\n".join(lines) + "\n"
