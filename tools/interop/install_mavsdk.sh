#!/bin/sh
# Installs MAVSDK (its server in C++ and its Python client, unmodified) into a virtual environment of its own, for
# tests/process/interop/test_mavlink_mavsdk.py. Linux x86_64.
#
#   tools/interop/install_mavsdk.sh DIR
#   TIC_VLA_MAVSDK_PYTHON=DIR/venv/bin/python pytest tests/process/interop/test_mavlink_mavsdk.py
set -eu

if [ $# -ne 1 ]; then
    echo "usage: $0 DIR    (where to put the environment, e.g. /tmp/mavsdk)" >&2
    exit 2
fi
mkdir -p "$1"
dir=$(cd "$1" && pwd)
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/python" -m pip install --quiet --disable-pip-version-check "mavsdk-grpc==4.0.5"
"$dir/venv/bin/python" -c "import mavsdk_grpc"
echo "$dir/venv/bin/python"
