#!/bin/sh
# Installs `far-unitree-sdk`, a Python binding of the robot maker's C++ SDK (unitree_sdk2 with its own Cyclone DDS 0.10.2
# inside), into a virtual environment of its own, for tests/process/interop/test_interop_far_sdk.py. Linux x86_64, Python 3.11.
#
#   tools/interop/install_far_sdk.sh DIR
#   TIC_VLA_FAR_PYTHON=DIR/venv/bin/python pytest tests/process/interop/test_interop_far_sdk.py
#
# The session runs in network namespaces (root): the binding speaks on DDS domain 0 only, which may be a real robot's.
set -eu

if [ $# -ne 1 ]; then
    echo "usage: $0 DIR    (where to put the environment, e.g. /tmp/far-sdk)" >&2
    exit 2
fi
mkdir -p "$1"
dir=$(cd "$1" && pwd)
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/python" -m pip install --quiet --disable-pip-version-check "far-unitree-sdk==0.1.8" numpy
"$dir/venv/bin/python" -c "import unitree_interface"
echo "$dir/venv/bin/python"
