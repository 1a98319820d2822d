#!/usr/bin/env bash
# Hybrid against splats alone at equal floats and three budgets, the same code, MCMC and Mip-Splatting's filters on both:
# `equal-floats.sh [options of centaur bench]`, such as `--scenes demo` or `--seeds 0,1`. On the demo capture, those of $CENTAUR_DATA and
# those of `make unbounded-captures`, as far as they are there; 1 to 2 minutes a run on 2 cores without a GPU. What is done is not done
# again. Results go to out/equal-floats/BUDGET, one table of all to out/equal-floats/table.md.
# EQUAL_FLOATS_BUDGETS="400000 800000", EQUAL_FLOATS_FLAGS="--iterations 300" (in place of those below), EQUAL_FLOATS_OUT=FOLDER,
# EQUAL_FLOATS_LPIPS=out/lpips-vgg.safetensors (of `make lpips-weights`: scores LPIPS, too; a path from the root of the repository).
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

# A bench that is stopped ends in its own way, which a shell takes for the end of that command alone.
trap 'exit 130' INT
failed=0
for budget in "${budgets[@]}"; do
    # Captures without masks/ are trained whole. Nothing else is set per scene.
    centaur bench $scenes -o "$out/$budget" "$@" \
        --variant hybrid="--layers 1 --triangles 6000 --texture-size 512 --band-degree 0" \
        --variant splats=--no-mesh \
        -- "${flags[@]}" --antialias --density mcmc --masks --max-floats "$budget" || failed=1
done
# Of all budgets there are, also of earlier runs.
python3 scripts/equal_floats_table.py "$out"/*/ | tee "$out/table.md"
exit $failed
