#!/usr/bin/env bash
# Installs what a fresh Debian or Ubuntu lacks to build, run and test Centaur: a C++ compiler (for meshoptimizer and
# FLIP), Python and, if the machine has no Vulkan adapter, Mesa's software adapter. Does nothing if all of these exist.
set -euo pipefail
cd "$(dirname "$0")"

[ "$(uname)" = Linux ] || exit 0 # Metal and DX12 come with the system; the compiler with Rust's own requirements.
missing=()
command -v c++ >/dev/null || missing+=(g++)
command -v python3 >/dev/null || missing+=(python3)
./has-vulkan.sh || missing+=(mesa-vulkan-drivers libvulkan1)
[ ${#missing[@]} -eq 0 ] || ./install.sh "${missing[@]}"
