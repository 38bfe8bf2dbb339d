"""Old name of `edge.flightlog.cleanup`; kept for commands that name it."""

from __future__ import annotations

import sys

from edge.flightlog.cleanup import main

if __name__ == "__main__":
    sys.stderr.write("edge.flight_logs: this command is now python -m edge.flightlog.cleanup\n")
    sys.exit(main())
