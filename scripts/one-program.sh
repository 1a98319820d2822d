# Sourced in the root of the repository: `centaur` runs the program that $1 names or, where it names none, a copy of what is built now. What is
# built while a series of runs lasts has no part in it.
if [ -n "$1" ]; then
    program=$1
else
    cargo build --release --quiet
    # Two steps: a failure within `cp "$(…)"` would be passed over.
    built=$(scripts/program.sh)
    copy=$(mktemp -d "${TMPDIR:-/tmp}/centaur-program.XXXXXX")
    trap 'rm -rf "$copy"' EXIT
    cp "$built" "$copy/centaur"
    program=$copy/centaur
fi
centaur() { "$program" "$@"; }
