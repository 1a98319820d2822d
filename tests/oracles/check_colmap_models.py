#!/usr/bin/env python3
"""Checks tests/data/colmap_models.json, which the unit tests read, against pycolmap's own projection.

    pip install pycolmap numpy
    python tests/oracles/check_colmap_models.py            # compare, exit 1 on a difference above 1e-9 pixels
    python tests/oracles/check_colmap_models.py --write    # make the file anew

Written with pycolmap 4.2.1, which knows all of these models. For each camera model the file contains parameters,
camera-space points and their pixels.
"""
import argparse
import json
import pathlib
import sys

import numpy as np
import pycolmap

FILE = pathlib.Path(__file__).parent.parent / "data" / "colmap_models.json"
F, FF, C = [500.0], [500.0, 510.0], [322.5, 237.25]
K4, K6 = [0.05, -0.02, 0.01, -0.003], [0.05, -0.02, 0.01, 0.003, 0.001, 0.0005]
T = [0.002, -0.001]
MODELS = {
    "SIMPLE_PINHOLE": F + C,
    "PINHOLE": FF + C,
    "SIMPLE_RADIAL": F + C + [-0.16],
    "RADIAL": F + C + K4[:2],
    "OPENCV": FF + C + K4[:2] + T,
    "OPENCV_FISHEYE": FF + C + K4,
    "FULL_OPENCV": FF + C + K4[:2] + T + [0.01, 0.02, 0.01, 0.005],
    "FOV": FF + C + [0.7],
    "SIMPLE_RADIAL_FISHEYE": F + C + [0.05],
    "RADIAL_FISHEYE": F + C + K4[:2],
    "THIN_PRISM_FISHEYE": FF + C + K4[:2] + T + [0.01, 0.003, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": FF + C + K6 + T + [0.003, 0.001, -0.002, 0.0004],
    "SIMPLE_DIVISION": F + C + [-0.1],
    "DIVISION": FF + C + [-0.1],
    "SIMPLE_FISHEYE": F + C,
    "FISHEYE": FF + C,
    "EUCM": FF + C + [0.6, 1.1],
}
POINTS = [[0.0, 0.0, 1.0], [0.4, -0.3, 1.0], [-0.7, 0.2, 1.5], [0.1, 0.9, 1.2], [-0.9, -0.8, 1.1], [2.0, 1.0, 2.5]]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write the file")
    arguments = parser.parse_args()
    if arguments.write:
        cases = [{"model": m, "params": p, "points": POINTS} for m, p in MODELS.items()]
    else:
        cases = json.loads(FILE.read_text())
    unknown = [m for m in MODELS if m not in pycolmap.CameraModelId.__members__]
    if unknown:
        sys.exit(f"pycolmap {pycolmap.__version__} does not know {', '.join(unknown)}")
    if [case["model"] for case in cases] != [*MODELS]:
        sys.exit(f"{FILE}: expected {', '.join(MODELS)}, found {', '.join(case['model'] for case in cases)}")
    differences = []
    for case in cases:
        camera = pycolmap.Camera(model=case["model"], width=640, height=480, params=case["params"])
        pixels = np.array(camera.img_from_cam(np.array(case["points"])))
        if arguments.write:
            case["id"] = int(camera.model)
            case["pixels"] = pixels.tolist()
        differences.append(np.abs(pixels - np.array(case["pixels"])).max())
        print(f"{case['model']:28} {differences[-1]:.1e} px")
    if arguments.write:
        FILE.write_text("[\n" + ",\n".join(json.dumps(c) for c in cases) + "\n]\n")
    # Unlike `max`, numpy's maximum propagates NaN.
    worst = np.max(differences)
    sys.exit(0 if worst < 1e-9 else f"largest difference {worst} px")


main()
