#!/usr/bin/env bash
# The peers' environment: install.sh DIR. Needs python3 ≥ 3.10, cmake and a C++ compiler (llama.cpp is built here).
set -euo pipefail
if [ "$#" -ne 1 ]; then
    echo "usage: $0 DIR   (then: python -m tools.bench.runtimes --peers-venv DIR …)" >&2
    exit 2
fi
here="$(cd "$(dirname "$0")" && pwd)"
"${PYTHON:-python3}" -m venv "$1"
"$1/bin/python" -m pip --disable-pip-version-check install -r "$here/requirements.txt"
