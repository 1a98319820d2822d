#!/usr/bin/env python3
"""Renders the same scenes in Centaur, Mitsuba, Blender's Cycles and numpy, and compares every pixel.

    python crosscheck.py --centaur "cargo run --release --" --scenes FOLDER --out FOLDER
                         [--blender-python PYTHON]... [--quick] [--only SCENE]...

Scenes are the .glb in FOLDER (examples/write_crosscheck writes them), each from its embedded cameras. Pictures are compared
in the space that the scene is blended in, over its background; layers premultiplied. OUT gets `crosscheck.html`, one page with
pictures, errors and figures, and `crosscheck.json`. Exit 1 if a gate is missed or a program fails.
"""
import argparse
import json
import pathlib
import shlex
import subprocess
import sys
import time

import numpy as np
import OpenEXR

import ray_model
import report
from composition import Asset, contract_of
from posed import Posed

# Least PSNR in dB for a peak of 1: (renderer, its construction) -> by content of the scene.
GATES = {
    "mitsuba": {"meshes": 70, "few": 80, "many": 65},
    "blender cap": {"meshes": 70, "few": 60, "many": 60},
    "blender ewa": {"meshes": 70, "few": 75, "many": 75},
    "numpy": {"meshes": 80, "few": 80, "many": 80},
    # Mitsuba without our plug-ins orders splats by the entry points of rays, and draws rays at random within a pixel.
    "mitsuba stock": {"few": 33, "many": 28},
}
# Limits for splats alone and for meshes alone, for all programs that render layers.
LAYER_GATE = 50
LAYERS = ["splats", "mesh"]
WITHOUT_LAYERS = ["mitsuba stock"]
# In Cycles a ray through the common edge of two facets of a `cap` hits both or neither: one to three pixels per
# picture. This many pixels with an error above 0.01 are counted and left out for its limits; `psnr` includes all.
CAP_EDGES = 5
# Largest difference between the picture and the sum of the contributions of splats and meshes.
SUM_LIMIT = 1e-5
# Number of splats above which a scene counts as large.
FEW = 1000
# Left out by --quick because they are slow.
SLOW = ["hybrid10k", "trained"]
# Scenes whose surfaces Cycles cannot show as intended: it shows all along a ray, not the nearest, and has no `stable`
# order.
NOT_CYCLES = ["nearest", "trained"]
# Animated scenes, with the times of comparison in seconds: frames at Blender's FPS.
TIMES = {"head": 0.8}
FPS = 30
# Cameras of a scene that are compared.
MOST_CAMERAS = 2


def run(command, timeout=1800):
    """Runs a program; on failure, the last line of its output is the reason."""
    started = time.time()
    done = subprocess.run([str(c) for c in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout)
    if done.returncode:
        lines = done.stdout.strip().splitlines() or ["nothing was printed"]
        raise RuntimeError(f"{pathlib.Path(str(command[0])).name} failed ({done.returncode}): {lines[-1]}")
    return time.time() - started, done.stdout


def read(path):
    """Reads an EXR as {"": RGBA, "splats": RGBA, "mesh": RGBA}, [h, w, 4], as far as it contains these."""
    channels = {}
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for part in file.parts:
            channels |= {name.split("ViewLayer.")[-1]: c.pixels.astype(np.float64) for name, c in part.channels.items()}
    layers = {}
    for layer in ("", *LAYERS):
        names = [f"{layer}.{c}" if layer else c for c in "RGBA"]
        if all(name in channels for name in names):
            layers[layer] = np.stack([channels[name] for name in names], -1)
    return layers


def read_rgb(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.parts[0].channels
        return np.stack([channels[c].pixels.astype(np.float64) for c in "RGB"], -1)


# --- Renderers: each gives {camera: ({layer: RGBA}, seconds)} for a scene ---


def place(folder, name):
    """Path of a picture, after removing one of an earlier run: it would be compared if a program succeeds without
    writing one."""
    picture = folder / name
    picture.unlink(missing_ok=True)
    return picture


def at_time(scene):
    return ["--time", TIMES[scene.stem]] if scene.stem in TIMES else []


def opaque(rgb):
    return np.concatenate([rgb, np.ones_like(rgb[..., :1])], -1)


def by_centaur(centaur, scene, out, model):
    folder = out / f"centaur-{model}"
    by_ray = ["--sh-direction", "ray"] if model == "ray, SH by ray" else []
    command = [*centaur, "render", scene, *at_time(scene), "--model", model.split(",")[0], *by_ray, "--exr-layers", "-o", folder]
    seconds, text = run([*command, "--json", "--quiet"])
    pictures = json.loads(text.strip().splitlines()[-1])["pictures"]
    return {i: (read(path), seconds / len(pictures)) for i, path in enumerate(pictures[:MOST_CAMERAS])}


def by_mitsuba(centaur, scene, cameras, out):
    xml = out / "mitsuba" / "scene.xml"
    xml.parent.mkdir(exist_ok=True)
    run([*centaur, "convert", scene, xml, *at_time(scene), "--quiet"])
    pictures = {}
    for i in range(cameras):
        exr = place(xml.parent, f"{i}.exr")
        plugins = xml.with_name("hybrid_rf.py")
        seconds, _ = run([sys.executable, plugins, xml, "-o", exr, "--camera", i, "--output", "blending"])
        pictures[i] = read(exr), seconds
    return pictures


def by_stock_mitsuba(centaur, scene, cameras, out):
    """Renders splats over black; pictures blended in sRGB are stored decoded, and are encoded again here."""
    xml = out / "mitsuba-stock" / "scene.stock.xml"
    xml.parent.mkdir(exist_ok=True)
    run([*centaur, "convert", scene, xml, *at_time(scene), "--quiet"])
    decodes = '"srgb_primitives" value="true"' in xml.read_text()
    pictures = {}
    for i in range(cameras):
        exr = place(xml.parent, f"{i}.exr")
        seconds, _ = run([sys.executable, pathlib.Path(__file__).with_name("stock_mitsuba.py"), xml, exr, i])
        rgb = read_rgb(exr)
        encoded = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * np.maximum(rgb, 0) ** (1 / 2.4) - 0.055) if decodes else rgb
        pictures[i] = {"": opaque(encoded)}, seconds
    return pictures


def by_blender(python, version, construction, centaur, scene, cameras, out):
    script = out / f"blender-{version}-{construction}" / "scene.blend.py"
    script.parent.mkdir(exist_ok=True)
    run([*centaur, "convert", scene, script, "--quiet"])
    frame = ["--frame", 1 + round(TIMES[scene.stem] * FPS)] if scene.stem in TIMES else []
    pictures = {}
    for i in range(cameras):
        exr = place(script.parent, f"{i}.exr")
        command = [python, script, "--render", exr, "--construction", construction, "--camera", i, "--layers", *frame]
        seconds, _ = run(command)
        pictures[i] = read(exr), seconds
    return pictures


def by_numpy(scene, cameras):
    pictures = {}
    for i in range(cameras):
        started = time.time()
        asset = Posed(scene, TIMES[scene.stem]) if scene.stem in TIMES else Asset(scene)
        both, splats, mesh = ray_model.render(asset, camera=i)
        pictures[i] = {"": both, "splats": splats, "mesh": mesh}, time.time() - started
    return pictures


# --- Comparison ---


def figures(ours, theirs):
    """`rest` is the PSNR of the pixels whose error is at most 0.01; None for a PSNR without error."""
    difference = np.abs(ours - theirs)
    difference[~np.isfinite(difference)] = 1
    is_above = difference.max(-1) > 1e-2
    psnr = lambda d: round(float(-10 * np.log10((d**2).mean())), 2) if d.any() else None
    return {
        "max": float(difference.max()),
        "mean": float(difference.mean()),
        "psnr": psnr(difference),
        "rest": psnr(difference[~is_above]),
        "above_1e-2": int(is_above.sum()),
    }


def over(image, background):
    return image[..., :3] + (1 - image[..., 3:]) * background


def compare(row, ours, theirs, background, gate, edges, layers):
    """Fills `row` with the errors of the picture and its `layers`, and returns whether they are within the limits, with
    at most `edges` pixels left out."""
    for found in (ours, theirs):
        if not {"", *layers} <= found.keys():
            raise RuntimeError(f"expected RGBA and the layers {layers}, found {sorted(found)}")
    if ours[""].shape != theirs[""].shape:
        raise RuntimeError(f"expected a picture of {ours[''].shape}, found {theirs[''].shape}")
    meets = lambda psnr, gate: psnr is None or psnr >= gate
    at_least = lambda f, gate: meets(f["psnr"], gate) or (f["above_1e-2"] <= edges and meets(f["rest"], gate))
    row |= figures(over(ours[""], background), over(theirs[""], background)) | {"gate": gate}
    row["alpha"] = figures(ours[""][..., 3:], theirs[""][..., 3:])
    row["passes"] = at_least(row, gate) and at_least(row["alpha"], gate)
    if layers:
        row["layers"] = {name: figures(ours[name], theirs[name]) for name in layers}
        row["sum_error"] = float(np.abs(theirs["splats"] + theirs["mesh"] - theirs[""])[..., :3].max())
        row["passes"] &= all(at_least(f, LAYER_GATE) for f in row["layers"].values()) and row["sum_error"] <= SUM_LIMIT
    row["pictures"] = [report.png(p) for p in (
        over(ours[""], background), over(theirs[""], background),
        10 * np.abs(over(ours[""], background) - over(theirs[""], background)),
    )]  # fmt: skip


def check(scene, arguments, out):
    """Rows of the table for one scene."""
    asset = Asset(scene)
    cameras = min(MOST_CAMERAS, sum("camera" in node for node, _ in asset.nodes()))
    background = np.array(contract_of(asset).get("background", [0, 0, 0]), float)
    splats = ray_model.splats_of(asset)
    count = 0 if splats is None else len(splats[0])
    if cameras == 0:
        sys.exit(f"crosscheck.py: {scene}: no cameras to compare it from")
    kind = "meshes" if count == 0 else "few" if count <= FEW else "many"
    out.mkdir(parents=True, exist_ok=True)
    centaur = arguments.centaur
    ours = {model: by_centaur(centaur, scene, out, model) for model in ("ray", "ewa")}
    gate_of = lambda program: GATES[program][kind]
    # (program, model to compare with, least PSNR, renderer)
    comparisons = [("mitsuba", "ray", gate_of("mitsuba"), lambda: by_mitsuba(centaur, scene, cameras, out))]
    if kind != "many":
        comparisons.append(("numpy", "ray", gate_of("numpy"), lambda: by_numpy(scene, cameras)))
    # The other scenes cannot be represented in a `.stock.xml`, which has no meshes.
    if all(ray_model.KHR in p.get("extensions", {}) for m in asset.json["meshes"] for p in m["primitives"]):
        ours_by_ray = "ray, SH by ray"
        comparisons.append(("mitsuba stock", ours_by_ray, gate_of("mitsuba stock"), lambda: by_stock_mitsuba(centaur, scene, cameras, out)))
        by_ray = by_centaur(centaur, scene, out, ours_by_ray)
        ours[ours_by_ray] = {i: ({"": opaque(layers[""][..., :3])}, seconds) for i, (layers, seconds) in by_ray.items()}
    for python in arguments.blender_python if scene.stem not in NOT_CYCLES else []:
        version = run([python, "-c", "import bpy; print('%d.%d.%d' % bpy.app.version)"])[1].split()[-1]
        for construction, model in [("cap", "ray"), ("ewa", "ewa")] if count else [("ewa", "ray")]:
            render = lambda python=python, v=version, c=construction: by_blender(python, v, c, centaur, scene, cameras, out)
            comparisons.append((f"blender {version} {construction}", model, gate_of(f"blender {construction}"), render))
    rows = []
    for name, model, gate, render in comparisons:
        try:
            theirs, error = render(), None
        except (RuntimeError, subprocess.TimeoutExpired, OSError) as e:
            theirs, error = {}, str(e)
        for i in range(cameras):
            row = {"scene": scene.stem, "camera": i, "splats": count, "program": name, "model": model, "passes": False}
            try:
                if error:
                    raise RuntimeError(error)
                edges = CAP_EDGES if name.endswith(" cap") else 0
                layers = [] if name in WITHOUT_LAYERS else LAYERS
                compare(row, ours[model][i][0], theirs[i][0], background, gate, edges, layers)
                row["seconds"] = {"ours": round(ours[model][i][1], 2), "theirs": round(theirs[i][1], 2)}
            except RuntimeError as e:
                row["error"] = str(e)
            rows.append(row)
            print(report.line(row), flush=True)
            if error:
                break
    return rows


def ensure_names(found, only, is_quick):
    """Stops if a name belongs to no scene, since settings for it would have no effect. With --quick, slow scenes need
    not exist."""
    known = set(found) | set(SLOW if is_quick else [])
    for what, names in [("--only", only), ("SLOW", SLOW), ("NOT_CYCLES", NOT_CYCLES), ("TIMES", TIMES)]:
        for name in names:
            if name not in known:
                sys.exit(f"crosscheck.py: {what}: expected one of the scenes {', '.join(sorted(known))}, found {name}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--centaur", type=shlex.split, required=True)
    parser.add_argument("--scenes", type=pathlib.Path, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--blender-python", action="append", default=[])
    parser.add_argument("--quick", action="store_true", help=f"leave out {', '.join(SLOW)}")
    parser.add_argument("--only", action="append", default=[])
    arguments = parser.parse_args()
    scenes = sorted(arguments.scenes.glob("*.glb"))
    if scenes:
        ensure_names([s.stem for s in scenes], arguments.only, arguments.quick)
    scenes = [s for s in scenes if (s.stem in arguments.only or not arguments.only) and not (arguments.quick and s.stem in SLOW)]
    if not scenes:
        sys.exit(f"crosscheck.py: {arguments.scenes}: no scenes (.glb)")
    started = time.time()
    rows = [row for scene in scenes for row in check(scene, arguments, arguments.out / scene.stem)]
    missed = [row for row in rows if not row["passes"]]
    summary = f"{len(rows) - len(missed)} of {len(rows)} comparisons pass, {time.time() - started:.0f} s"
    if not arguments.blender_python:
        summary += "; Blender was not run: there is no --blender-python"
    report.write(arguments.out, summary, rows)
    print(summary)
    print(arguments.out / "crosscheck.html")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
