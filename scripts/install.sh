#!/usr/bin/env bash
# install.sh PACKAGE…: installs Debian packages, as root or through sudo, with three attempts.
set -euo pipefail

if ! command -v apt-get >/dev/null; then
    echo "error: missing: $*. No apt-get here: install their equivalents and run again" >&2
    exit 1
fi
as_root=()
if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || { echo "error: missing: $*. Run as root: apt-get install $*" >&2; exit 1; }
    as_root=(sudo)
fi
echo "installing $*"
for attempt in 1 2 3; do
    # A single unreachable source does not prevent the installation.
    "${as_root[@]}" apt-get update -qq || echo "warning: apt-get update failed: installing what the lists know that are there" >&2
    # sudo clears the environment, hence env.
    if "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -y -qq --no-install-recommends "$@" >/dev/null; then
        exit 0
    fi
    [ $attempt -eq 3 ] || sleep $((attempt * 10))
done
echo "error: could not install $*" >&2
exit 1
