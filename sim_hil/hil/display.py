"""Check for an X server at DISPLAY before opening a window: without one, PyBullet ends the whole process."""

from __future__ import annotations

import re
import socket
from contextlib import closing
from typing import Final

SOCKETS: Final = "/tmp/.X11-unix"  # X(7): folder of local sockets; display number N listens at XN
FIRST_PORT: Final = 6000  # TCP port of display 0; display N listens at 6000 + N
TIMEOUT_S: Final = 2.0
_NAME: Final = re.compile(r"(?:(?P<protocol>unix|tcp|inet6?)/)?(?P<host>.*):(?P<number>\d{1,4})(?:\.\d+)?")


class DisplayError(ValueError):
    """No X server at the display; one line for the user."""


def check_display(name: str | None, sockets: str = SOCKETS) -> None:
    """Check that an X server listens at display `name`, [HOST]:N[.SCREEN] as in DISPLAY. Raises DisplayError."""
    if not name:
        raise DisplayError("--gui: expected a display, found DISPLAY unset; run without --gui or on a desktop")
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
            f"--gui: DISPLAY={name}: expected an X server, found none ({why}); run without --gui or on a desktop"
        ) from error


def _reach_local(path: str) -> None:
    try:
        _reach("\0" + path)  # Linux's abstract socket name, which needs no file
    except OSError:
        _reach(path)


def _reach(path: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(TIMEOUT_S)
        client.connect(path)
