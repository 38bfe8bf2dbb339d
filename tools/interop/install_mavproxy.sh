#!/bin/sh
# Installs MAVProxy, a ground station on the command line (GPL; only run, never imported), into a virtual environment of
# its own, for tests/process/interop/test_mavlink_mavproxy.py.
#
#   tools/interop/install_mavproxy.sh DIR
#   TIC_VLA_MAVPROXY=DIR/venv/bin/mavproxy.py pytest tests/process/interop/test_mavlink_mavproxy.py
set -eu

if [ $# -ne 1 ]; then
    echo "usage: $0 DIR    (where to put the environment, e.g. /tmp/mavproxy)" >&2
    exit 2
fi
mkdir -p "$1"
dir=$(cd "$1" && pwd)
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/python" -m pip install --quiet --disable-pip-version-check "MAVProxy==1.8.75" setuptools
"$dir/venv/bin/mavproxy.py" --version
echo "$dir/venv/bin/mavproxy.py"
