#!/usr/bin/env bash
# ignored-tests.sh [REASON…]: lists the tests that `cargo test` leaves out, with reasons, except those with one of the
# given reasons.
set -euo pipefail
cd "$(dirname "$0")/.."

find src tests -name '*.rs' -print0 | sort -z | xargs -0 awk -v run="$(printf '|%s' "$@")|" '
    match($0, /#\[ignore = "[^"]*"\]/) { reason = substr($0, RSTART + 12, RLENGTH - 14); next }
    reason != "" && match($0, /fn [a-z0-9_]+/) {
        if (!index(run, "|" reason "|")) { left[reason] = left[reason] "\n  " FILENAME ": " substr($0, RSTART + 3, RLENGTH - 3); n++ }
        reason = ""
    }
    END {
        print n + 0 " tests left out" (n ? ":" : ".")
        for (reason in left) print " " reason left[reason]
    }'
