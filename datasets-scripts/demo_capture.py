"""Renders the demo capture with Mitsuba 3 and writes it as JPEG pictures and a COLMAP binary model with exact poses.

    python demo_capture.py ../demo              # render everything and check it
    python demo_capture.py ../demo --check      # only check what is there

An interrupted run is resumed when started again with the same arguments; until the end the folder is not a capture.
"""

import argparse
import sys
from pathlib import Path

try:
    import mitsuba as mi
    import numpy as np
    from PIL import Image
except ImportError as error:
    sys.exit(f"error: {error}; install it with: pip install -r {Path(__file__).with_name('requirements.txt')}")

import demo_scene
import rendering
from colmap_model import Camera, centre_of, facing, read_model, write_model
from mitsuba_capture import cast, ensure_outputs, ensure_views, load_scene, misalignment, pictures_of, render, sample, samples, seen, take

# Off-centre on purpose: a reader that assumes the centre of the picture has an error of 6 and 4 pixels.
CAMERA = Camera(224, 168, 288.0, (224 / 2 + 6.0, 168 / 2 - 4.0))
VIEWS, ELEVATIONS, DISTANCE = 48, (11.0, 29.0, 50.0), 3.6
LOOK_AT = np.array([0.0, 0.0, 0.6])
POINTS, POINT_NOISE = 6000, 0.005


def view_pose(index):
    """World-to-camera rotation [3, 3] and translation [3], COLMAP axes: x right, y down, z forward.

    The azimuth advances steadily while the height cycles, so that every eighth view (the test split) covers both
    ranges.
    """
    rng = np.random.default_rng(1000 + index)
    azimuth = np.radians(360 * index / VIEWS + rng.uniform(-2, 2))
    elevation = np.radians(ELEVATIONS[index % 3] + rng.uniform(-3, 3))
    distance = DISTANCE * rng.uniform(0.95, 1.05)
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return facing(LOOK_AT + distance * back, back)


def load():
    return load_scene(demo_scene.build(), {
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.76, 0.80, 0.87]}},
        "window": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([2.6, -2.2, 4.4], [0, 0, 0.4], [0, 0, 1]) @ mi.ScalarTransform4f().scale(1.3),
            "light": {"type": "area", "radiance": {"type": "rgb", "value": [10.4, 9.4, 7.9]}},
        },
    })


def picture_of(scene, index, spp):
    return render(scene, CAMERA, view_pose(index), spp, index, (0.1, 20.0), hide_emitters=True)


def sparse_points(scene, poses, pictures, rng):
    """Surface points seen by at least three views: positions [P, 3] with noise as in SfM, and median colours [P, 3]."""
    positions, colours = [], []
    while len(positions) < POINTS:
        pose = poses[rng.integers(len(poses))]
        direction = CAMERA.ray(pose, rng.uniform([1, 1], [CAMERA.width - 1, CAMERA.height - 1]))
        eye = centre_of(pose)
        distance = cast(scene, eye, direction)
        if not np.isfinite(distance):
            continue
        point = eye + distance * direction
        found = [sample(pictures[k], p) for k in range(len(poses)) if (p := seen(scene, CAMERA, poses[k], point)) is not None]
        if len(found) >= 3:
            positions.append(point + POINT_NOISE * rng.normal(size=3))
            colours.append(np.median(found, axis=0))
    return np.array(positions), np.clip(np.array(colours) + 0.5, 0, 255).astype(np.uint8)


def outline_error(scene, pose, picture, offset):
    """Share of pixels that are black although their ray hits the scene, or vice versa; rays are shifted by `offset`
    pixels."""
    ys, xs = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width : 2]
    wrong = 0
    for x, y in zip(xs.ravel(), ys.ravel()):
        hit = np.isfinite(cast(scene, centre_of(pose), CAMERA.ray(pose, (x + 0.5 + offset[0], y + 0.5 + offset[1]))))
        wrong += hit != (picture[y, x].max() > 24)
    return wrong / xs.size


def check(scene, folder):
    """Checks that poses, intrinsics and pictures agree: outlines, texture transferred between views, colours at
    projected points."""
    poses, positions, colours, _, _ = read_model(folder / "sparse/0")
    pictures = pictures_of(folder, len(poses))
    rng = np.random.default_rng(7)

    offsets = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
    outline = {o: np.mean([outline_error(scene, poses[k], pictures[k], o) for k in (4, 23)]) for o in offsets}
    print("outline pixels that differ, by shift:", ", ".join(f"{o} {100 * e:.2f} %" for o, e in outline.items()))
    shifts = np.array([misalignment(scene, CAMERA, poses, pictures, a, (a + 1) % len(poses), 1500, rng) for a in range(0, len(poses), 4)])
    print(f"texture shift between neighbouring views: mean {shifts.mean(0).round(3)}, largest {np.abs(shifts).max():.3f} pixel")
    errors = []
    for _ in range(4000):
        k, p = rng.integers(len(poses)), rng.integers(len(positions))
        pixel = seen(scene, CAMERA, poses[k], positions[p])
        if pixel is not None:
            errors.append(np.abs(sample(pictures[k], pixel) - colours[p]).mean())
    print(f"colour difference at {len(errors)} projected points: median {np.median(errors):.1f}/255")
    if min(outline, key=outline.get) != (0, 0) or np.abs(shifts).max() > 0.2:
        raise SystemExit("pictures and poses do not agree")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="output folder, for images/ and sparse/0/")
    parser.add_argument("--spp", type=samples, default=256, help="samples per pixel (a square number)")
    parser.add_argument("--only", type=int, nargs="*", help="render only these views as PNG into FOLDER, as a preview")
    parser.add_argument("--check", action="store_true", help="do not render, only check")
    arguments = parser.parse_args(arguments)
    ensure_outputs(arguments)
    ensure_views(arguments.only, VIEWS)
    scene = load()
    folder = arguments.folder
    if arguments.only is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for i in arguments.only:
            Image.fromarray(picture_of(scene, i, arguments.spp)).save(folder / f"{i:03d}.png")
        return
    if not arguments.check:
        take(lambda i: picture_of(scene, i, arguments.spp), folder, VIEWS, {"spp": arguments.spp})
        poses = [view_pose(i) for i in range(VIEWS)]
        points = sparse_points(scene, poses, pictures_of(folder, VIEWS), np.random.default_rng(3))
        rendering.finish(folder, lambda model: write_model(model, CAMERA, poses, *points))
    check(scene, folder)


if __name__ == "__main__":
    main()
