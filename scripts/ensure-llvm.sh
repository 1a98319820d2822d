#!/usr/bin/env bash
# ensure-llvm.sh [LIB]: Mitsuba's Dr.Jit needs LLVM as a library; 19 is what hybrid_rf.py is tested with. Those before 17 end the
# process on some machines. LIB, an absolute path, stands for /usr/lib in a test.
set -euo pipefail
cd "$(dirname "$0")"
lib=${1:-/usr/lib}

[ "$(uname)" = Linux ] || exit 0 # hybrid_rf.py looks where Homebrew puts it, and Windows' wheels bring it.
# Beside the machine's own folder there may be one of 32 bits. `ls` fails where one of the two folders is not there.
installed() {
    { ls "$lib/$(uname -m)-linux-gnu"/libLLVM*.so* "$lib"/llvm-*/lib/libLLVM*.so* 2>/dev/null || true; } |
        grep -E 'libLLVM(-|\.so\.)(1[7-9]|[2-9][0-9])' >/dev/null
}

if [ -n "${DRJIT_LIBLLVM_PATH:-}" ] || installed; then exit 0; fi
./install.sh libllvm19
