#!/usr/bin/env bash
# Where cargo puts the program, wherever its configuration says: `program.sh`.
set -euo pipefail
cd "$(dirname "$0")/.."
echo "$(cargo metadata --format-version 1 --no-deps | sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release/centaur"
