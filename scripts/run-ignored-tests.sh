#!/usr/bin/env bash
# run-ignored-tests.sh NAME… [OPTION…]: runs the ignored integration tests that have one of the NAMEs in theirs, with options of the harness.
# Fails where a NAME is in none: of that the harness says nothing.
set -euo pipefail

test=(cargo test --release --test integration)
for name in "$@"; do
    [[ $name != -* ]] || continue
    found=$("${test[@]}" --quiet -- --ignored --list "$name")
    [[ $found == *': test'* ]] || { echo "error: no ignored test has $name in its name" >&2; exit 1; }
done
exec "${test[@]}" --no-fail-fast -- --ignored "$@"
