"""One end of `between`: waits for its cable, gives it an address, becomes the command. Runs in its own namespace.

A line on standard input says that the cable is there; the command gets an empty standard input of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Final

INTERFACE: Final = "eth0"


def main(argv: list[str]) -> int:
    """`ADDRESS COMMAND...`; does not return when the command could be started."""
    address, *command = argv
    if not sys.stdin.readline():
        return 1  # whoever was to lay the cable has gone
    for arguments in (
        ["link", "set", "lo", "up"],
        ["addr", "add", address, "dev", INTERFACE],
        ["link", "set", INTERFACE, "up"],
    ):
        subprocess.run(["ip", *arguments], check=True)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.stderr.write(f"{command[0]}: {error.strerror}\n")
        return 127


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
