#!/usr/bin/env bash
# ensure-python.sh VERSION PYTHON…: fails with one line unless the command PYTHON is of that version or a later one, or
# of exactly that version if VERSION begins with =.
set -euo pipefail

wanted=$1
shift
found=$("$@" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || found="none that runs"
if [[ $wanted == =* ]]; then
    [ "$found" != "${wanted#=}" ] || exit 0
    wanted=${wanted#=}
else
    ! "$@" -c 'import sys; sys.exit(sys.version_info[:2] < tuple(map(int, sys.argv[1].split("."))))' "$wanted" 2>/dev/null || exit 0
    wanted+=" or later"
fi
echo "error: expected Python $wanted, found $found ($*): make PYTHON=… names another, for Blender BLENDER_PYTHON=…" >&2
exit 1
