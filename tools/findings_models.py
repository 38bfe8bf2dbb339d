"""Old name of `tools.findings.models`; kept for commands that name it."""

from __future__ import annotations

import sys

from tools.findings.models import main

if __name__ == "__main__":
    sys.stderr.write("tools.findings_models: this command is now python -m tools.findings.models\n")
    sys.exit(main())
