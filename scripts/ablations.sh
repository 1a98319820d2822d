#!/usr/bin/env bash
# Measures the effect of each choice of the hybrid, at equal floats: `ablations.sh [options of centaur bench]`, such as
# `--scenes demo` or `--jobs 2`.
# Uses the demo capture, and as far as they exist those of $CENTAUR_DATA and those of `make unbounded-captures`: 25 runs
# per capture and seed, about 2 minutes per run on 2 cores without a GPU. The table goes to out/ablations.
# Variables: ABLATIONS_FLAGS="--max-side 176 …" (replaces the training flags below), ABLATIONS_OUT=FOLDER,
# ABLATIONS_CENTAUR=PROGRAM, ABLATIONS_LPIPS=out/lpips-vgg.safetensors (from `make lpips-weights`: also scores LPIPS).
set -euo pipefail
cd "$(dirname "$0")/.."
scenes=target/ablations
mkdir -p $scenes
. scripts/link-captures.sh
read -ra flags <<<"${ABLATIONS_FLAGS:---iterations 1000 --surface-iterations 600 --warmup 600 --max-side 356 --max-floats 1000000}"
# Warm-ups in the same proportion to joint iterations as 3,000 and 9,000 to 30,000. As in the program, by default a
# seventh of the iterations precedes the surface, at least 400 and at most half, and always half with refined poses or
# without MCMC.
value() { # flag, default value
    local found=$2 i
    for ((i = 0; i < ${#flags[@]}; i++)); do
        case "${flags[i]}" in "$1") found=${flags[i + 1]:?$1 needs a value} ;; "$1="*) found=${flags[i]#*=} ;; esac
    done
    echo "$found"
}
iterations=$(value --iterations 30000)
before=$((iterations / 7 > 400 ? iterations / 7 : 400))
before=$((before < iterations / 2 ? before : iterations / 2))
if [[ " ${flags[*]} " == *" --refine-poses "* || $(value --density mcmc) != mcmc ]]; then before=$((iterations / 2)); fi
joint=$((iterations - $(value --surface-iterations "$before")))
joint=$((joint > 0 ? joint : 0))
[ -z "${ABLATIONS_LPIPS:-}" ] || flags+=(--lpips-weights "$ABLATIONS_LPIPS")
centaur=(cargo run --release --quiet --)
[ -z "${ABLATIONS_CENTAUR:-}" ] || centaur=("$ABLATIONS_CENTAUR")
# Captures without masks/ are trained unmasked. The first variant is the one that the others change; --warmup 0 keeps
# every triangle, with maps of half the budget.
"${centaur[@]}" bench $scenes -o "${ABLATIONS_OUT:-out/ablations}" "$@" \
    --variant hybrid \
    --variant splats=--no-mesh \
    --variant direct="--mode direct" \
    --variant stable="--mode stable" \
    --variant layers-2="--layers 2" \
    --variant layers-4="--layers 4" \
    --variant lambda-0="--lambda 0" \
    --variant lambda-0-003="--lambda 0.003" \
    --variant lambda-0-03="--lambda 0.03" \
    --variant lambda-0-1="--lambda 0.1" \
    --variant lambda-inf="--lambda inf" \
    --variant texture-128="--texture-size 128" \
    --variant texture-256="--texture-size 256" \
    --variant warmup-0="--warmup 0" \
    --variant warmup-tenth="--warmup $((joint / 10))" \
    --variant warmup-three-tenths="--warmup $((joint * 3 / 10))" \
    --variant warmup-200="--warmup 200" \
    --variant surface-of-splats="--surface splats" \
    --variant surface-of-points="--surface points" \
    --variant planar-off="--planar off" \
    --variant shell-off="--shell off" \
    --variant inria="--density inria" \
    --variant absgs="--density absgs" \
    --variant antialias=--antialias \
    --variant splats-antialias="--no-mesh --antialias" \
    -- --layers 1 --triangles 6000 --texture-size 512 --masks "${flags[@]}"
