# Sourced in the root of the repository: links the demo and, as far as they exist, the captures of $CENTAUR_DATA and
# those of `make unbounded-captures` into the folder $scenes.
link() { # name, capture
    # An existing link to the same capture is kept: another run may be reading through it.
    if [ -d "$2/sparse" ]; then
        local place
        place=$(cd "$2" && pwd -P)
        [ "$(readlink "$scenes/$1")" = "$place" ] || ln -sfn "$place" "$scenes/$1"
    else
        [ -d "$scenes/$1/" ] || rm -f "$scenes/$1"
        if [ -d "$scenes/$1/" ]; then echo "$1: that of a former run, $(readlink "$scenes/$1")"; else echo "$1: left out, $2 is not there"; fi
    fi
}
link demo demo
for name in banana16 skull66 maryrose69; do link $name "${CENTAUR_DATA:-/none}/capture_$name"; done
for name in garden street room; do link $name target/unbounded/$name; done
