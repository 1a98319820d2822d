#!/usr/bin/env bash
# Compares conversions by Centaur and by PlayCanvas' splat-transform (npm) of the same splats of degree 3, taking the
# best of several runs: wall time in seconds, processor time in seconds, peak memory. `convert-times.sh [SPLATS
# [RUNS]]`, by default 1,000,000 and 3. Compare wall times on an idle machine only. Needs node 20, GNU time, and 2.5 kB
# of disk per splat.
set -euo pipefail
cd "$(dirname "$0")/.."
splats=${1:-1000000} runs=${2:-3}
theirs=${CENTAUR_SPLAT_TRANSFORM:?names the program splat-transform; make convert-times sets it}
ours=${CENTAUR:-}
if [ -z "$ours" ]; then
    cargo build --release --quiet
    ours=$(scripts/program.sh)
fi
export XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-/tmp}
folder=$(mktemp -d "${TMPDIR:-/tmp}/centaur-convert.XXXXXX")
trap 'rm -rf "$folder"' EXIT
cd "$folder"

# Smooth fields with noise, which compress about as well as trained splats.
cat >splats.mjs <<'JS'
import fs from 'node:fs';
const n = Number(process.argv[2]), out = fs.openSync('scene.ply', 'w');
const names = ['x', 'y', 'z', 'nx', 'ny', 'nz', ...[0, 1, 2].map(i => `f_dc_${i}`), ...Array.from({ length: 45 }, (_, i) => `f_rest_${i}`),
    'opacity', 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3'];
fs.writeSync(out, `ply\nformat binary_little_endian 1.0\nelement vertex ${n}\n${names.map(p => `property float ${p}\n`).join('')}end_header\n`);
let state = 1;
const uniform = () => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0) / 2 ** 32;
const normal = () => uniform() + uniform() + uniform() + uniform() - 2;
const rows = 20000;
for (let start = 0; start < n; start += rows) {
    const count = Math.min(rows, n - start), block = new Float32Array(count * 62);
    for (let i = 0; i < count; i++) {
        const row = block.subarray(62 * i, 62 * (i + 1)), reach = [2, 5, 20][i % 3];
        for (let k = 0; k < 3; k++) row[k] = reach * normal();
        for (let k = 0; k < 3; k++) row[6 + k] = Math.sin(1.3 * row[k]) + 0.5 * normal();
        for (let k = 0; k < 45; k++) row[9 + k] = 0.08 * Math.sin(0.3 * row[k % 3] + k) + 0.05 * normal();
        row[54] = 5 * normal();
        for (let k = 55; k < 58; k++) row[k] = 2 * normal() - 5;
        const q = [normal(), normal(), normal(), normal()], length = Math.hypot(...q) || 1;
        for (let k = 0; k < 4; k++) row[58 + k] = q[k] / length;
    }
    fs.writeSync(out, new Uint8Array(block.buffer));
}
JS
node splats.mjs "$splats"

measure() { # program and arguments; prints wall, processor time and memory of the fastest run
    for _ in $(seq "$runs"); do
        /usr/bin/time -o times -f '%e %U %S %M' "$@" >log 2>&1 || { cat log >&2; return 1; }
        tail -1 times
    done | sort -n | awk 'NR == 1 { printf "%6.2f s %6.2f s %6.0f MB", $1, $2 + $3, $4 / 1024 }'
}

compare() { # name, input, output, options of Centaur, options of splat-transform
    local name=$1 input=$2 output=$3
    local own their
    own=$(measure "$ours" convert "$input" "ours-$output" --quiet $4)
    their=$(measure "$theirs" --quiet --overwrite -g cpu "$input" $5 "theirs-$output")
    printf '%-22s | %s %5.0f MB | %s %5.0f MB\n' "$name" "$own" "$(size "ours-$output")" "$their" "$(size "theirs-$output")"
}

size() { # in MB
    awk -v bytes="$(stat -c %s "$1")" 'BEGIN { print bytes / 1e6 }'
}

echo "$splats splats of degree 3, $(size scene.ply) MB of PLY, best of $runs runs"
printf '%-22s | %-34s | %s\n' '' "Centaur: wall, CPU, memory, file" 'splat-transform'
compare 'PLY to SPZ' scene.ply a.spz '' ''
compare 'PLY to compressed PLY' scene.ply a.compressed.ply '' ''
compare 'PLY to PLY, turned' scene.ply turned.ply '--rotate 30,40,50 --scale 2' '-r 30,40,50 -s 2'
compare 'PLY to PLY, Morton' scene.ply sorted.ply '--morton' '-m'
compare 'PLY to glb' scene.ply a.glb '' ''
compare 'SPZ to PLY' theirs-a.spz spz.ply '' ''
compare 'compressed PLY to PLY' theirs-a.compressed.ply packed.ply '' ''
# splat-transform builds its palette by exhaustive search: without a GPU a million splats take many minutes.
node splats.mjs 10000
compare 'PLY to SOG, 10,000' scene.ply a.sog '' ''
