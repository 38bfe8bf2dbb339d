"""One side of `between`, in its own namespace: wait for the cable, set its address, and execute the command.

A line on standard input signals that the cable exists; the command gets an empty standard input.
"""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Final

INTERFACE: Final = "eth0"


def main(argv: list[str]) -> int:
    """Run `ADDRESS COMMAND...`; returns only if the command cannot be started."""
    address, *command = argv
    if not sys.stdin.readline():
        return 1  # the parent ended
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
