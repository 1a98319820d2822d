#!/usr/bin/env bash
# What each choice of the hybrid is worth, at equal floats: `ablations.sh [options of centaur bench]`, such as `--scenes demo` or `--jobs 2`.
# On the demo capture, on those of $CENTAUR_DATA and on those of `make unbounded-captures`, as far as they are there: 25 runs a capture and seed,
# about 2 minutes a run on 2 cores without a GPU. The table goes to out/ablations.
# ABLATIONS_FLAGS="--max-side 176 …" (in place of those of training below), ABLATIONS_OUT=FOLDER, ABLATIONS_CENTAUR=PROGRAM,
# ABLATIONS_LPIPS=out/lpips-vgg.safetensors (of `make lpips-weights`: scores LPIPS, too).
set -euo pipefail
cd "$(dirname "$0")/.."
scenes=target/ablations
mkdir -p $scenes
. scripts/link-captures.sh
read -ra flags <<<"${ABLATIONS_FLAGS:---iterations 1000 --surface-iterations 600 --warmup 600 --max-side 356 --max-floats 1000000}"
# Warm-ups in the proportion to joint iterations that 3,000 and 9,000 have to 30,000; by default a seventh of the iterations is before the surface,
# at least 400 and at most half, and half where the program has it so.
value() { # flag, value where it is not given
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
# Captures without masks/ are trained whole. The first is what the others change; --warmup 0 leaves every triangle in place, with maps of half the budget.
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
