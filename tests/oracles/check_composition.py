#!/usr/bin/env python3
"""Compares `centaur render` with composition.py, a second implementation of EXT_gaussian_splatting_hybrid.

    python check_composition.py CENTAUR SCENE.glb… [--trained SCENE.glb…]      # CENTAUR: path of the program, or a command: "cargo run --"

Each given scene, and a harder one made from it, is rendered from its first camera in all modes with 1, 2 and 4 layers,
by that script and by the program CENTAUR, which gets a copy with a changed scene object. Exit 1 if an image differs by
more than MOST in any value, or by more than LIMIT on average: a tenth of what the extension's README allows for a claim
of *composition*, and less than images of two modes differ by. A trained scene has many splats behind each other in
every pixel, some of which pass a threshold of the specification (a contribution of 1/255, a transmittance of 10⁻⁴) by
less than single precision resolves: only there, a share of CUT_OFFS of the values may differ by more than MOST, none by
more than FAR.
"""
import concurrent.futures
import functools
import itertools
import json
import os
import pathlib
import shlex
import subprocess
import sys
import tempfile

import numpy as np
import OpenEXR

from composition import EXT, KHR, Asset, View, contract_of, project_splats, render

LIMIT = 1e-4  # ten times the accumulated single-precision rounding over some tens of layers of splats
MOST = 1e-3  # the same for the worst value; images of two modes differ by more than 2·LIMIT on average
CUT_OFFS = 5e-4  # 14 values of 28,224, or five pixels; scenes of several different trainings had 1 to 4 values
FAR = 1e-2  # two and a half times 1/255, the most that a splat at its threshold adds for a colour of 1; colours can be larger
MODES = ["stable", "surfaceConsistent", "direct"]


def crowded(path):
    """A harder scene made from the file at `path`: several intersecting copies of its meshes, one stretched and one
    mirrored, more transparent; its splats larger, more transparent, and moved, rotated and stretched by their node; 112
    pixels wide, with a background, cut by the near plane, and with a normalised footprint."""
    asset = Asset(path)
    json_ = asset.json
    data = bytearray(asset.bin)
    for primitive in (p for m in json_["meshes"] for p in m["primitives"] if KHR in p.get("extensions", {})):
        for name, width, factor in [("SCALE", 3, 4), ("OPACITY", 1, 0.4)]:
            accessor = json_["accessors"][primitive["attributes"][f"{KHR}:{name}"]]
            start = json_["bufferViews"][accessor["bufferView"]]["byteOffset"]
            values = np.ndarray(width * accessor["count"], "<f4", data, start)
            values *= factor
    asset.bin = bytes(data)
    root = json_["nodes"][json_["scenes"][0]["nodes"][0]]
    for index in list(root["children"]):
        node = json_["nodes"][index]
        if "camera" in node:
            own = json_["cameras"][node["camera"]]["extras"]["centaur"]
            factor = 112 / own["width"]
            own.update(width=112, height=round(factor * own["height"]), **{k: factor * own[k] for k in ["fx", "fy", "cx", "cy"]})
        elif KHR in json_["meshes"][node["mesh"]]["primitives"][0].get("extensions", {}):
            node.update(rotation=[0.1, 0.2, -0.1, 0.94 ** 0.5], translation=[0.1, -0.2, 0.05], scale=[1.2, 0.9, 1.1])
        else:
            for turn, scale in (([0, 0.5, 0, 0.75 ** 0.5], [0.9] * 3), ([0.3, 0.1, 0, 0.9 ** 0.5], [1, 0.8, 0.9]),
                                ([0, 0, 0.8, 0.6], [-0.9, 0.9, 0.9])):
                json_["nodes"].append({"mesh": node["mesh"], "rotation": turn, "scale": scale, "translation": [0.1, 0.05, 0.1]})
                root["children"].append(len(json_["nodes"]) - 1)
    for material in json_["materials"]:
        material["extensions"][EXT]["opacity"].update(offset=[-1], scale=[0.5])
    depths = project_splats(asset, View(asset), 0.0)[0]
    contract_of(asset).update(background=[0.1, 0.2, 0.3], near=float(np.float32(np.quantile(depths, 0.05))),
                              footprint={"variance": 0.1, "normalized": True})
    return asset


def centaur_render(program, asset):
    """The program's image of the first camera, in the scene's colour space."""
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder, "scene.glb")
        for node in [n for n, _ in asset.nodes() if "camera" in n][1:]:
            del node["camera"]
        asset.write(copy)
        command = [*program, "render", copy, "-o", folder, "--format", "exr", "--json", "--quiet"]
        pictures = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["pictures"]
        with OpenEXR.File(pictures[0]) as file:
            image = file.channels()["RGB"].pixels.astype(np.float64)
    if contract_of(asset)["colorSpace"] == "lin_rec709_display":
        return image
    return np.where(image <= 0.0031308, 12.92 * image, 1.055 * np.maximum(image, 0) ** (1 / 2.4) - 0.055)


def both(asset, program, rule):
    """The image by this rule, its λ, and its difference from the program's image."""
    mode, layers, share = rule
    contract = contract_of(asset)
    contract.update(mode=mode, layers=layers)
    contract.pop("lambda", None)
    if share:
        depths = project_splats(asset, View(asset), 0.0)[0]
        contract["lambda"] = float(np.float32(share * np.ptp(depths)))
    image = render(asset)
    return image, contract.get("lambda", np.inf), abs(image - centaur_render(program, asset))


def compare(name, asset, program, trained):
    """Whether all modes, numbers of layers, a finite and the infinite λ are within the limits; and the images."""
    ok, images = True, {}
    rules = [(mode, *rest) for mode, rest in itertools.product(MODES, [(1, 0.1), (2, 0.1), (4, 0.1), (2, None)])]
    with concurrent.futures.ProcessPoolExecutor() as processes:
        results = list(processes.map(functools.partial(both, asset, program), rules))
    for rule, (image, lambda_, difference) in zip(rules, results):
        mode, layers, _ = rule
        images[rule] = image
        apart = int((difference >= MOST).sum())
        within = difference.mean() < LIMIT and (difference.max() < MOST or trained and difference.max() < FAR and apart <= CUT_OFFS * difference.size)
        ok &= within
        print(f"{name:18} {mode:18} L {layers} λ {lambda_:<6.2g} mean {difference.mean():.1e}  "
              f"max {difference.max():.1e}  above {MOST}: {apart} of {difference.size}{'' if within else '  FAILED'}", flush=True)
    return ok, images


def main():
    program, paths = shlex.split(sys.argv[1]), sys.argv[2:]
    ok, apart, trained = True, {}, False
    for path in paths:
        if path == "--trained":
            trained = True
            continue
        name = os.path.basename(path)
        ok &= compare(name, Asset(path), program, trained)[0]
        within, images = compare(f"{name} crowded", crowded(path), program, trained)
        ok &= within
        for a, b in itertools.combinations(images, 2):
            if a[2] == b[2] and (a[0] == b[0]) != (a[1] == b[1]):
                apart[a, b] = max(apart.get((a, b), 0), abs(images[a] - images[b]).mean())
    # Images that are equal in all modes would agree whatever the rule.
    print(f"images of two modes or numbers of layers differ by {min(apart.values()):.1e} at least")
    sys.exit(not (ok and min(apart.values()) > 2 * LIMIT))


if __name__ == "__main__":
    main()
