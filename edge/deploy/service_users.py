"""Users and groups of the installed services: the bridge commands the robot, the runner asks it to, people may stop."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from edge.deploy.unit_text import UnitError

SYSUSERS_FILE: Final = "tic-vla-edge.conf"
BRIDGE_USER: Final = "tic-vla-bridge"
RUNNER_USER: Final = "tic-vla-runner"
OPERATOR_GROUP: Final = "tic-vla-operators"
_NAME = re.compile(r"[a-z_][a-z0-9_-]{0,30}", re.ASCII)


@dataclass(frozen=True)
class ServiceUsers:
    """Users of the two services, each with a group of its own name, and the group of the people that may operate."""

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
    """Text of a sysusers.d(5) file that makes the services' users and the operators' group."""
    return (
        "# Made by edge-install units.\n"
        f'u {users.bridge} - "tic-vla-edge bridge" - -\n'
        f'u {users.runner} - "tic-vla-edge runner" - -\n'
        f"g {users.operators} -\n"
    )
