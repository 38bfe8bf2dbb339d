"""Is there an X server behind DISPLAY? PyBullet ends the whole process when there is none."""

from __future__ import annotations

import re
import socket
from contextlib import closing
from typing import Final

SOCKETS: Final = "/tmp/.X11-unix"  # X(7): where the server of this machine with number N listens, as XN
FIRST_PORT: Final = 6000  # of one that is reached over TCP, plus its number
TIMEOUT_S: Final = 2.0
_NAME: Final = re.compile(r"(?:(?P<protocol>unix|tcp|inet6?)/)?(?P<host>.*):(?P<number>\d{1,4})(?:\.\d+)?")


class DisplayError(ValueError):
    """No window can be opened; one line for the operator."""


def check_display(name: str | None, sockets: str = SOCKETS) -> None:
    """Raises DisplayError unless something listens at the display `name`, as DISPLAY has it: [HOST]:N[.SCREEN]."""
    if not name:
        raise DisplayError("--gui: expected a display, DISPLAY is not set; run without --gui or on a desktop")
    found = _NAME.fullmatch(name)
    if found is None:
        raise DisplayError(f"--gui: DISPLAY={name}: expected [HOST]:NUMBER such as :0; run without --gui")
    number = int(found["number"])
    local = found["host"] in ("", "unix") or found["protocol"] == "unix"
    try:
        if name.startswith("/"):
            _reach(name)  # the socket's own path, as on macOS
        elif local:
            _reach_local(f"{sockets}/X{number}")
        else:
            with closing(socket.create_connection((found["host"].strip("[]"), FIRST_PORT + number), TIMEOUT_S)):
                pass
    except OSError as error:
        why = error.strerror or error
        raise DisplayError(
            f"--gui: DISPLAY={name}: expected an X server, nobody answers ({why}); run without --gui or on a desktop"
        ) from error


def _reach_local(path: str) -> None:
    try:
        _reach("\0" + path)  # Linux's abstract name, which is there without a file
    except OSError:
        _reach(path)


def _reach(path: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(TIMEOUT_S)
        client.connect(path)
