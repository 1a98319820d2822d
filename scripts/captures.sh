#!/usr/bin/env bash
# Compares hybrid with splats alone at the same number of floats, on the demo capture and on the captures in
# $CENTAUR_DATA: at larger sizes than `make equal-floats` and without filters. `captures.sh [SEED…]`, by default 0 and
# 1; about 2 minutes per run on 2 cores without a GPU.
# Finished runs are not repeated, and stopped ones are resumed; after a change of code or settings delete the folder.
# Reports, pictures and JSON go to out/captures.
# Variables: CAPTURES_CENTAUR=PROGRAM, CAPTURES_OUT=FOLDER.
set -euo pipefail
cd "$(dirname "$0")/.."
data=${CENTAUR_DATA:-}
out=${CAPTURES_OUT:-out/captures}
mkdir -p "$out"
. scripts/one-program.sh "${CAPTURES_CENTAUR:-}"
# A training that is done just as Ctrl-C stops it exits normally, so the shell would only end that command.
trap 'exit 130' INT

compare() { # name, capture, floats, iterations, flags for the capture
    local name=$1 capture=$2 floats=$3 iterations=$4 kind
    shift 4
    if [ ! -d "$capture" ]; then
        echo "$name: left out, $capture is not there"
        return
    fi
    for seed in $seeds; do
        for kind in hybrid splats; do
            local run=$out/$name-$kind-$seed flags=(--no-mesh)
            [ $kind = splats ] || flags=(--surface-iterations 600 --warmup 600 --layers 1 --triangles 6000 --texture-size 512)
            [ ! -f "$run.glb.checkpoint" ] || flags+=(--resume)
            if ! grep -qs '"outcome":"finished"' "$run.json"; then
                centaur train "$capture" -o "$run.glb" --report "$run" --json --quiet \
                    --iterations "$iterations" --max-floats "$floats" --seed "$seed" "$@" "${flags[@]}" >"$run.part" || {
                    local code=$?
                    # Stopped by a signal; other failures say what they are.
                    [ $code -lt 128 ] || echo "$name: stopped; the same command goes on" >&2
                    exit $code
                }
                mv "$run.part" "$run.json"
            fi
            python3 - "$run.json" "$name" "$kind" "$seed" <<'PYTHON'
import json, sys
run = json.load(open(sys.argv[1]))
e = run["evaluation"]
print(f"{sys.argv[2]:12} {sys.argv[3]:7} seed {sys.argv[4]}  {e['psnr']:.2f} dB  SSIM {e['ssim_inria']:.4f}  {e['splats']} splats  "
      f"{e['triangles']} triangles  {e['total_floats']} floats  {e['file_bytes']} bytes  {run['seconds_per_iteration']:.3f} s/iteration")
PYTHON
        done
    done
}

seeds=${*:-0 1}
compare demo demo 1000000 1000
compare banana16 "$data/capture_banana16" 1300000 1000 --max-side 376
compare skull66 "$data/capture_skull66" 2000000 1000 --max-side 356
compare maryrose69 "$data/capture_maryrose69" 1500000 800 --max-side 432 --masks
