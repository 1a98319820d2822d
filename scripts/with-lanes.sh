#!/usr/bin/env bash
# with-lanes.sh LANES COMMAND…: runs a command where Mesa's software adapter has subgroups of so many lanes. Where tests run on another
# adapter, whose lanes are its own, says so instead.
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
