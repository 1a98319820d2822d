#!/usr/bin/env bash
# Compares stable and surface-consistent order with direct order where splats lie near surfaces: on scenes whose true
# surface is known (the demo and, as far as they exist, those of `make unbounded-captures`). The surface is given as the
# mesh, so that runs differ only in the order. `order-modes.sh [options of centaur bench]`, such as `--seeds 0,1,2`;
# about 1 minute per run on 2 cores without a GPU. Finished runs are not repeated. Results go to out/order-modes/SCENE,
# and a table of all differences to out/order-modes/table.md.
# Variables: ORDER_MODES_FLAGS="--iterations 300" (replaces those below), ORDER_MODES_OUT=FOLDER,
# ORDER_MODES_CENTAUR=PROGRAM, ORDER_MODES_PYTHON=PROGRAM (with numpy and pillow, for the surfaces).
set -euo pipefail
cd "$(dirname "$0")/.."
scenes=target/order-modes
out=${ORDER_MODES_OUT:-out/order-modes}
read -ra flags <<<"${ORDER_MODES_FLAGS:---max-side 176 --iterations 800 --warmup 240 --max-floats 600000 --texture-size 256 --band-degree 0}"
. scripts/one-program.sh "${ORDER_MODES_CENTAUR:-}"
mkdir -p $scenes "$out"
. scripts/link-captures.sh

# A bench that Ctrl-C stops ends in its own way, so the shell would only end that command.
trap 'exit 130' INT
failed=0
for scene in demo garden street room; do
    [ -d "$scenes/$scene/" ] || continue
    truth="$out/$scene.ply"
    if [ ! -f "$truth" ] || [ -n "$(find datasets-scripts -name '*.py' -newer "$truth")" ]; then
        "${ORDER_MODES_PYTHON:-python3}" datasets-scripts/true_surface.py $scene "$truth.new.ply"
        if [ -f "$truth" ] && ! cmp -s "$truth" "$truth.new.ply" && [ -d "$out/$scene" ]; then
            rm "$truth.new.ply"
            echo "error: $out/$scene: its results are of another surface than scripts make now: delete it and $truth" >&2
            exit 1
        fi
        mv "$truth.new.ply" "$truth"
    fi
    centaur bench $scenes --scenes $scene -o "$out/$scene" "$@" \
        --variant stable="--mode stable" \
        --variant surface-consistent="--mode surface-consistent" \
        --variant direct="--mode direct" \
        -- "${flags[@]}" --mesh "$truth" --layers 1 --antialias --density mcmc || {
        code=$?
        # Stopped by a signal.
        [ $code -lt 128 ] || exit $code
        failed=1
    }
done
python3 scripts/order_modes_table.py "$out" | tee "$out/table.md"
exit $failed
