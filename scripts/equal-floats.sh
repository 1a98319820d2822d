#!/usr/bin/env bash
# Compares hybrid with splats alone at equal floats and three budgets, both with the same code, MCMC and Mip-Splatting's
# filters: `equal-floats.sh [options of centaur bench]`, such as `--scenes demo` or `--seeds 0,1`. Uses the demo
# capture, and as far as they exist those of $CENTAUR_DATA and those of `make unbounded-captures`; 1 to 2 minutes per
# run on 2 cores without a GPU. Finished runs are not repeated. Results go to out/equal-floats/BUDGET, and a table of
# all to out/equal-floats/table.md.
# Variables: EQUAL_FLOATS_BUDGETS="400000 800000", EQUAL_FLOATS_FLAGS="--iterations 300" (replaces those below),
# EQUAL_FLOATS_OUT=FOLDER, EQUAL_FLOATS_LPIPS=out/lpips-vgg.safetensors (from `make lpips-weights`: also scores LPIPS; a
# path relative to the root of the repository).
set -euo pipefail
cd "$(dirname "$0")/.."
scenes=target/equal-floats
out=${EQUAL_FLOATS_OUT:-out/equal-floats}
read -ra budgets <<<"${EQUAL_FLOATS_BUDGETS:-300000 600000 1200000}"
read -ra flags <<<"${EQUAL_FLOATS_FLAGS:---max-side 534 --iterations 800 --surface-iterations 320 --warmup 240}"
[ -z "${EQUAL_FLOATS_LPIPS:-}" ] || flags+=(--lpips-weights "$EQUAL_FLOATS_LPIPS")
. scripts/one-program.sh "${EQUAL_FLOATS_CENTAUR:-}"

mkdir -p $scenes "$out"
. scripts/link-captures.sh

# A bench that Ctrl-C stops ends in its own way, so the shell would only end that command.
trap 'exit 130' INT
failed=0
for budget in "${budgets[@]}"; do
    # Captures without masks/ are trained unmasked. Nothing else is set per scene.
    centaur bench $scenes -o "$out/$budget" "$@" \
        --variant hybrid="--layers 1 --triangles 6000 --texture-size 512 --band-degree 0" \
        --variant splats=--no-mesh \
        -- "${flags[@]}" --antialias --density mcmc --masks --max-floats "$budget" || {
        code=$?
        # Stopped by a signal.
        [ $code -lt 128 ] || exit $code
        failed=1
    }
done
# All budgets that exist, including those of earlier runs.
python3 scripts/equal_floats_table.py "$out"/*/ | tee "$out/table.md"
exit $failed
