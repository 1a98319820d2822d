#!/usr/bin/env bash
# ensure-llvm.sh [LIB]: Mitsuba's Dr.Jit needs LLVM as a library; hybrid_rf.py is tested with version 19. Versions
# before 17 crash the process on some machines. LIB, an absolute path, replaces /usr/lib in a test.
set -euo pipefail
cd "$(dirname "$0")"
lib=${1:-/usr/lib}

[ "$(uname)" = Linux ] || exit 0 # hybrid_rf.py looks in Homebrew's folder, and Windows' wheels contain it.
# Beside the machine's own folder there can be a 32-bit one. `ls` fails if one of the two folders does not exist.
installed() {
    { ls "$lib/$(uname -m)-linux-gnu"/libLLVM*.so* "$lib"/llvm-*/lib/libLLVM*.so* 2>/dev/null || true; } |
        grep -E 'libLLVM(-|\.so\.)(1[7-9]|[2-9][0-9])' >/dev/null
}

if [ -n "${DRJIT_LIBLLVM_PATH:-}" ] || installed; then exit 0; fi
./install.sh libllvm19
