"""Text of systemd's files: values quoted so that systemd reads them back unchanged, and the users of the services.

Sources: systemd.syntax(7), systemd.service(5), sysusers.d(5).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

SYSUSERS_FILE: Final = "tic-vla-edge.conf"
BRIDGE_USER: Final = "tic-vla-bridge"
RUNNER_USER: Final = "tic-vla-runner"
OPERATOR_GROUP: Final = "tic-vla-operators"
_NAME = re.compile(r"[a-z_][a-z0-9_-]{0,30}", re.ASCII)

Setting = tuple[str, str]
"""Key and value of one line; a value may be empty, which resets a list."""


class UnitError(ValueError):
    """A value that a unit cannot contain; the message is one line."""


def word(text: str) -> str:
    """Quote one word of a list or a command's program: quotes, backslashes and specifiers (%) are taken literally.

    Raises UnitError for control characters, which not every setting can carry.
    """
    odd = [character for character in text if not character.isprintable()]
    if odd:
        raise UnitError(f"{text!r}: a unit cannot carry the character {odd[0]!r}; expected printable text")
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"'


def argument(text: str) -> str:
    """Quote one argument of a command: as `word`, and a dollar sign is taken literally too. Raises UnitError."""
    return word(text).replace("$", "$$")


def bound(path: str) -> str:
    """Quote a path of BindReadOnlyPaths=, where a colon is the separator; raises UnitError."""
    if ":" in path:
        raise UnitError(f"{path}: expected a path without a colon, which separates in BindReadOnlyPaths=; move it")
    return word(path)


def render(comment: Sequence[str], sections: Mapping[str, Sequence[Setting | str]]) -> str:
    """Format a unit: `# comment` lines, then each section's settings; a bare string there is a comment."""
    lines = [f"# {line}" for line in comment]
    for section, settings in sections.items():
        lines += ["", f"[{section}]"]
        lines += [f"# {entry}" if isinstance(entry, str) else f"{entry[0]}={entry[1]}" for entry in settings]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class ServiceUsers:
    """Users of the two services, each with a group of its own name, and the operators' group.

    The bridge commands the robot, the runner commands the bridge, operators may stop and arm. Raises UnitError.
    """

    bridge: str = BRIDGE_USER
    runner: str = RUNNER_USER
    operators: str = OPERATOR_GROUP

    def __post_init__(self) -> None:
        given = {"--bridge-user": self.bridge, "--runner-user": self.runner, "--operator-group": self.operators}
        defaults = (BRIDGE_USER, RUNNER_USER, OPERATOR_GROUP)
        for (option, name), default in zip(given.items(), defaults, strict=True):
            if not _NAME.fullmatch(name) or name == "root":
                raise UnitError(f"{option} {name}: expected the name of an ordinary user or group, such as {default}")
        if len(set(given.values())) < len(given):
            raise UnitError(
                f"{', '.join(given)}: expected three names, found {', '.join(given.values())}: a runner with the"
                " bridge's or the operators' rights could take back an emergency stop"
            )


def sysusers(users: ServiceUsers) -> str:
    """Return the sysusers.d file that creates the services' users and the operators' group."""
    return (
        "# Made by edge-install units.\n"
        f'u {users.bridge} - "tic-vla-edge bridge" - -\n'
        f'u {users.runner} - "tic-vla-edge runner" - -\n'
        f"g {users.operators} -\n"
    )
