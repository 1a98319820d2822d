#!/usr/bin/env bash
# run-ignored-tests.sh NAME… [OPTION…]: runs the ignored integration tests whose names contain one of the NAMEs, with
# options for the test harness. Fails if a NAME is in none, which the harness would not report.
set -euo pipefail

test=(cargo test --release --test integration)
for name in "$@"; do
    [[ $name != -* ]] || continue
    found=$("${test[@]}" --quiet -- --ignored --list "$name")
    [[ $found == *': test'* ]] || { echo "error: no ignored test has $name in its name" >&2; exit 1; }
done
exec "${test[@]}" --no-fail-fast -- --ignored "$@"
