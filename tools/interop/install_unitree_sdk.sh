#!/bin/sh
# Installs the robot maker's own Python SDK, unmodified, into a virtual environment of its own, for
# tests/process/interop/test_interop_unitree_sdk.py. It needs Cyclone DDS 0.10.2 (the robot's version), which has no wheel: Debian
# bookworm packages the library, and the Python binding is built against it.
#
#   sudo apt-get install --no-install-recommends cyclonedds-dev cyclonedds-tools gcc python3-dev
#   tools/interop/install_unitree_sdk.sh DIR
#   TIC_VLA_SDK_PYTHON=DIR/venv/bin/python pytest tests/process/interop/test_interop_unitree_sdk.py
#
# Keep DIR: the binding loads DIR/prefix/lib/libddsc.so at run time.
# `unitree-sdk2py-dimos` 1.0.3 is unitreerobotics/unitree_sdk2_python as a package: core/, rpc/, go2/, idl/, comm/ and
# utils/ are byte-identical to the maker's repository. (`unitree-sdk2` on PyPI cannot be imported.)
set -eu

if [ $# -ne 1 ]; then
    echo "usage: $0 DIR    (where to put the environment, e.g. /tmp/unitree-sdk)" >&2
    exit 2
fi
dir=$1
python=${PYTHON:-python3}
mkdir -p "$dir/prefix/bin" "$dir/prefix/lib"
dir=$(cd "$dir" && pwd)

idlc=$(command -v idlc || true)
libdir=/usr/lib/$(gcc -print-multiarch)
if [ -z "$idlc" ] || [ ! -e "$libdir/libddsc.so" ]; then
    echo "$0: Cyclone DDS 0.10.2 not found (idlc, $libdir/libddsc.so);" \
        "run: apt-get install cyclonedds-dev cyclonedds-tools" >&2
    exit 1
fi
# The binding's build looks for one prefix with bin/, lib/ and include/; Debian spreads them.
ln -sfn "$idlc" "$dir/prefix/bin/idlc"
ln -sfn "$libdir/libddsc.so" "$dir/prefix/lib/libddsc.so"
ln -sfn "$libdir/libcycloneddsidl.so" "$dir/prefix/lib/libcycloneddsidl.so"
ln -sfn /usr/include "$dir/prefix/include"

"$python" -m venv "$dir/venv"
pip="$dir/venv/bin/python -m pip install --quiet --disable-pip-version-check"
$pip "setuptools<70" wheel
CYCLONEDDS_HOME="$dir/prefix" $pip --no-build-isolation "cyclonedds==0.10.2"
$pip numpy opencv-python-headless
# --no-deps: it asks for opencv-python, whose GUI libraries a headless machine lacks.
$pip --no-deps "unitree-sdk2py-dimos==1.0.3"
"$dir/venv/bin/python" -c "import unitree_sdk2py.go2.sport.sport_client, unitree_sdk2py.go2.video.video_client"
echo "$dir/venv/bin/python"
