#!/usr/bin/env bash
# Mitsuba's Dr.Jit needs LLVM as a library; 19 is what hybrid_rf.py is tested with. Those before 17 end the process on some machines.
set -euo pipefail
cd "$(dirname "$0")"

[ "$(uname)" = Linux ] || exit 0 # hybrid_rf.py looks where Homebrew puts it, and Windows' wheels bring it.
# `ls` fails where one of the two folders is not there.
installed() { { ls /usr/lib/*/libLLVM*.so* /usr/lib/llvm-*/lib/libLLVM*.so* 2>/dev/null || true; } | grep -E 'libLLVM(-|\.so\.)(1[7-9]|[2-9][0-9])' >/dev/null; }

if [ -n "${DRJIT_LIBLLVM_PATH:-}" ] || installed; then exit 0; fi
./install.sh libllvm19
