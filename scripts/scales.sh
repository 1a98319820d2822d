#!/usr/bin/env bash
# Trains hybrid and splats alone, with and without the filters of Mip-Splatting, on pictures of a quarter of the size
# and scores them at ×½, ×1, ×2 and ×4 of that size: `scales.sh [NAME…]`, by default skull66 and banana16, captures in
# $CENTAUR_DATA. About 4 minutes per run on 2 cores without a GPU, four runs per capture; finished runs are not
# repeated. Scenes, scores and table.md go to out/scales/FLOATS-ITERATIONS.
# Variables: SCALES_FLOATS=1475000, SCALES_ITERATIONS=1000, SCALES_CENTAUR=PROGRAM, SCALES_OUT=FOLDER.
set -euo pipefail
cd "$(dirname "$0")/.."
floats=${SCALES_FLOATS:-1475000}
iterations=${SCALES_ITERATIONS:-1000}
out=${SCALES_OUT:-out/scales}/$floats-$iterations
. scripts/one-program.sh "${SCALES_CENTAUR:-}"
# A training that is done just as Ctrl-C stops it exits normally, so the shell would only end that command.
trap 'exit 130' INT

hybrid=(--surface-iterations $((iterations * 6 / 10)) --warmup $((iterations * 6 / 10)) --layers 1 --triangles 6000 --texture-size 512)
mkdir -p "$out"
[ $# -gt 0 ] || set -- skull66 banana16
for name in "$@"; do
    capture=${CENTAUR_DATA:-/none}/capture_$name
    if [ ! -d "$capture" ]; then
        echo "$name: left out, $capture is not there"
        continue
    fi
    for kind in hybrid splats; do
        for filters in none antialias; do
            scene=$out/$name-$kind-$filters
            flags=(--no-mesh)
            [ $kind = splats ] || flags=("${hybrid[@]}")
            [ $filters = none ] || flags+=(--antialias)
            [ ! -f "$scene.glb.checkpoint" ] || flags+=(--resume)
            [ -f "$scene.glb" ] || centaur train "$capture" -o "$scene.glb" --downscale 4 --iterations "$iterations" --max-floats "$floats" "${flags[@]}" || {
                code=$?
                # Stopped by a signal; other failures say what they are.
                [ $code -lt 128 ] || echo "$name: stopped; the same command goes on" >&2
                exit $code
            }
            for size in 8 4 2 1; do
                [ ! -f "$scene-$size.json" ] || continue
                # Written completely or not at all.
                centaur eval "$scene.glb" "$capture" --downscale $size --json --quiet >"$scene.part"
                mv "$scene.part" "$scene-$size.json"
            done
        done
    done
done
python3 - "$out" <<'PYTHON' | tee "$out/table.md"
import json, sys
from pathlib import Path

scores = {}
for file in sorted(Path(sys.argv[1]).glob("*-[1248].json")):
    name, kind, filters, size = file.stem.rsplit("-", 3)
    scores.setdefault((name, kind, filters), {})[int(size)] = json.loads(file.read_text())
print("| capture | scene | filters | ×½ | ×1 | ×2 | ×4 | splats | triangles |")
print("|---|---|---|---|---|---|---|---|---|")
for (name, kind, filters), sizes in sorted(scores.items()):
    rows = [f"{e['psnr']:.2f} / {e['ssim_inria']:.3f} / {e['flip']:.3f}" if (e := sizes.get(size)) else "" for size in (8, 4, 2, 1)]
    any_of = next(iter(sizes.values()))
    print(f"| {name} | {kind} | {filters} | {' | '.join(rows)} | {any_of['splats']:,} | {any_of['triangles']:,} |")
PYTHON
