"""Old name of `sim_hil.protocols.can.drive`; kept for commands that name it."""

from __future__ import annotations

import sys

from sim_hil.protocols.can.drive import main

if __name__ == "__main__":
    sys.stderr.write("sim_hil.can.drive: this command is now python -m sim_hil.protocols.can.drive\n")
    sys.exit(main())
