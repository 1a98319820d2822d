# Sourced in the root of the repository: `centaur` runs the program $1 or, if that is empty, a copy of the current
# build, so that builds during a series of runs have no effect on it.
if [ -n "$1" ]; then
    program=$1
else
    cargo build --release --quiet
    # Two steps: a failure within `cp "$(…)"` would be ignored.
    built=$(scripts/program.sh)
    copy=$(mktemp -d "${TMPDIR:-/tmp}/centaur-program.XXXXXX")
    trap 'rm -rf "$copy"' EXIT
    cp "$built" "$copy/centaur"
    program=$copy/centaur
fi
centaur() { "$program" "$@"; }
