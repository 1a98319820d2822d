#!/usr/bin/env bash
# Prints the path where cargo puts the program, according to its configuration: `program.sh`.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(cargo metadata --format-version 1 --no-deps | sed -n 's/.*"target_directory":"\([^"]*\)".*/\1/p')
[ -n "$folder" ] || { echo "error: cargo metadata: expected a target_directory, found none" >&2; exit 1; }
echo "$folder/release/centaur"
