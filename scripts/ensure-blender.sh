#!/usr/bin/env bash
# ensure-blender.sh PYTHON: installs the X libraries to which Blender as a module of PYTHON is linked, if the machine
# lacks them because it has no screen.
set -euo pipefail

[ "$(uname)" = Linux ] || exit 0
python=$(realpath -s "$1")
cd "$(dirname "$0")"
lacks_library() { [[ $("$python" -c 'import bpy' 2>&1 || true) == *'cannot open shared object file'* ]]; }

lacks_library || exit 0
./install.sh libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1 libvulkan1
if lacks_library; then
    "$python" -c 'import bpy' 2>&1 | tail -n 1 >&2
    exit 1
fi
