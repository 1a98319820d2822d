#!/usr/bin/env bash
# What each choice of the hybrid is worth, at equal floats: `ablations.sh [options of centaur bench]`, such as `--scenes demo` or `--jobs 2`.
# On the demo capture and on those of $CENTAUR_DATA; about 2 minutes a run on 2 cores without a GPU. The table goes to out/ablations.
# ABLATIONS_FLAGS="--max-side 176 …" (in place of those of training below), ABLATIONS_OUT=FOLDER, ABLATIONS_CENTAUR=PROGRAM,
# ABLATIONS_LPIPS=out/lpips-vgg.safetensors (of `make lpips-weights`: scores LPIPS, too).
set -euo pipefail
cd "$(dirname "$0")/.."
scenes=target/ablations
mkdir -p $scenes
ln -sfn "$PWD/demo" $scenes/demo
for name in banana16 skull66; do
    [ ! -d "${CENTAUR_DATA:-/none}/capture_$name" ] || ln -sfn "$CENTAUR_DATA/capture_$name" $scenes/$name
done
read -ra flags <<<"${ABLATIONS_FLAGS:---iterations 1000 --surface-iterations 600 --warmup 600 --max-side 356 --max-floats 1000000}"
[ -z "${ABLATIONS_LPIPS:-}" ] || flags+=(--lpips-weights "$ABLATIONS_LPIPS")
centaur=(cargo run --release --quiet --)
[ -z "${ABLATIONS_CENTAUR:-}" ] || centaur=("$ABLATIONS_CENTAUR")
# The first is what the others change; --warmup 0 leaves every triangle in place, with maps of half the budget.
"${centaur[@]}" bench $scenes -o "${ABLATIONS_OUT:-out/ablations}" "$@" \
    --variant hybrid \
    --variant splats=--no-mesh \
    --variant direct="--mode direct" \
    --variant surface-consistent="--mode surface-consistent" \
    --variant layers-2="--layers 2" \
    --variant layers-4="--layers 4" \
    --variant lambda-0="--lambda 0" \
    --variant lambda-0-1="--lambda 0.1" \
    --variant lambda-inf="--lambda inf" \
    --variant texture-128="--texture-size 128" \
    --variant texture-256="--texture-size 256" \
    --variant warmup-0="--warmup 0" \
    --variant warmup-200="--warmup 200" \
    --variant surface-of-splats="--surface splats" \
    --variant surface-of-points="--surface points" \
    --variant inria="--density inria" \
    --variant antialias=--antialias \
    --variant splats-antialias="--no-mesh --antialias" \
    -- --layers 1 --triangles 6000 --texture-size 512 "${flags[@]}"
