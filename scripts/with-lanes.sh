#!/usr/bin/env bash
# with-lanes.sh LANES COMMAND…: runs a command with Mesa's software adapter using subgroups of LANES lanes. If tests run
# on another adapter, which has its own number of lanes, prints that instead.
set -euo pipefail

lanes=$1
shift
export LP_NATIVE_VECTOR_WIDTH=$((32 * lanes))
adapter=$(cargo run --release --quiet -- devices)
case $(head -n 3 <<<"$adapter") in
    *llvmpipe*", subgroups of $lanes,"*) "$@" ;;
    *llvmpipe*) printf 'error: expected subgroups of %s lanes, found\n%s\n' "$lanes" "$adapter" >&2; exit 1 ;;
    *) echo "left out: subgroups of $lanes lanes, since tests run on ${adapter%%$'\n'*}" ;;
esac
