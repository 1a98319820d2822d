"""Renders unbounded captures with Mitsuba 3: JPEG pictures and a COLMAP model with exact poses, and points as from SfM.

    python unbounded_capture.py garden FOLDER             # ring of cameras about a table; houses, trees, hills, sky
    python unbounded_capture.py street FOLDER             # walk through a street
    python unbounded_capture.py room FOLDER               # all around in a room with windows
    python unbounded_capture.py garden FOLDER --check     # only check what is there

Points are triangulated from noisy pixels in at least three views, if they are consistent, and tracks are written. An
interrupted run is resumed when started again with the same arguments; until the end FOLDER is not a capture.
"""

import argparse
import sys
import time
from pathlib import Path

try:
    import mitsuba as mi
    import numpy as np
    from PIL import Image
except ImportError as error:
    sys.exit(f"error: {error}; install it with: pip install -r {Path(__file__).with_name('requirements.txt')}")

import rendering
from colmap_model import centre_of, read_model, write_model
from mitsuba_capture import (
    cast,
    encoded,
    ensure_outputs,
    ensure_views,
    load_scene,
    misalignment,
    pictures_of,
    radiance,
    render,
    sample,
    samples,
    seen,
    take,
)
from triangulation import triangulate, widest_angle
from unbounded_garden import garden
from unbounded_room import room
from unbounded_street import street

SCENES = {"garden": garden, "room": room, "street": street}
POINTS, PIXEL_NOISE, MATCHED = 4000, 0.35, 0.8
# By default COLMAP drops points under 1.5 degrees, and with them all hills; its users lower that for such captures.
LEAST_ANGLE, LARGEST_ERROR = np.radians(0.15), 2.0
# Descriptors do not match across large differences in viewing direction or distance.
LARGEST_TURN, LARGEST_ZOOM = np.cos(np.radians(50)), 2.5


NEAR_FAR = (0.05, 1e4)


def load(world):
    """The scene in which rays are cast."""
    return load_scene(world["shapes"] + world.get("indoors", []), daylight(world))


def daylight(world):
    sky = mi.Bitmap(world["sky"])
    return {
        # Mitsuba's environment map has y up.
        "sky": {"type": "envmap", "bitmap": sky, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)},
        "sun": {"type": "directional", "direction": list(world["sun"]), "irradiance": {"type": "rgb", "value": [2.9, 2.65, 2.3]}},
    }


def lamplight(world):
    colour = lambda power: {"type": "rgb", "value": [power, 0.93 * power, 0.8 * power]}
    return {f"lamp{i}": {"type": "point", "position": list(at), "intensity": colour(power)} for i, (at, power) in enumerate(world["lamps"])}


def photographer(scene, world, spp):
    """Returns the function that renders a view. Indoor surfaces are lit by lamps directly and by no other light:
    daylight through a window, or indirect light close to a lamp, would be noisy."""
    camera, poses = world["camera"], world["poses"]
    if "indoors" not in world:
        return lambda i: render(scene, camera, poses[i], spp, i, NEAR_FAR, hide_emitters=False)
    inside, outside = load_scene(world["indoors"], lamplight(world)), load_scene(world["shapes"], daylight(world))

    def picture(i):
        room = radiance(inside, camera, poses[i], spp, i, NEAR_FAR, hide_emitters=True, depth=2)
        view = radiance(outside, camera, poses[i], spp, i, NEAR_FAR, hide_emitters=False)
        return encoded(room[..., :3] + (1 - room[..., 3:]) * view[..., :3])

    return picture


def tolerance(distance):
    """Tolerance of the depth test: a surface closer than the point by less does not occlude it."""
    return 2e-3 * max(1.0, distance)


def detail(picture):
    """Probability of a feature at every pixel, from the gradient of the luminance."""
    grey = picture.astype(float).mean(-1)
    gy, gx = np.gradient(grey)
    strength = np.hypot(gx, gy) + 0.5
    strength[:2], strength[-2:], strength[:, :2], strength[:, -2:] = 0, 0, 0, 0
    return (strength / strength.sum()).ravel()


def sparse_points(scene, camera, poses, pictures, rng):
    """Positions, colours, observations per view, errors: see write_model."""
    eyes, chances = [centre_of(p) for p in poses], [detail(p) for p in pictures]
    positions, colours, errors, observations = [], [], [], [[] for _ in poses]
    while len(positions) < POINTS:
        first = rng.integers(len(poses))
        pixel = np.array(divmod(rng.choice(len(chances[first]), p=chances[first]), camera.width))[::-1] + rng.uniform(size=2)
        direction = camera.ray(poses[first], pixel)
        distance = cast(scene, eyes[first], direction)
        if not np.isfinite(distance):
            continue
        point = eyes[first] + distance * direction
        found = {}
        for k, pose in enumerate(poses):
            offset = point - eyes[k]
            far = np.linalg.norm(offset)
            alike = offset @ direction > LARGEST_TURN * far and 1 / LARGEST_ZOOM < far / distance < LARGEST_ZOOM
            if alike and (p := seen(scene, camera, pose, point, tolerance(far))) is not None:
                found[k] = p
        matched = [k for k in found if rng.uniform() < MATCHED]
        noisy = {k: np.add(found[k], PIXEL_NOISE * rng.normal(size=2)) for k in found}
        position = None
        if len(matched) >= 3 and widest_angle([eyes[k] for k in matched], point) > LEAST_ANGLE:
            position, error = triangulate(camera, [poses[k] for k in matched], [noisy[k] for k in matched], point)
        if position is None or error > LARGEST_ERROR:
            continue
        for k in found:
            observations[k].append((*noisy[k], len(positions) if k in matched else None))
        positions.append(position)
        errors.append(error)
        colours.append(np.median([sample(pictures[k], found[k]) for k in matched], axis=0))
    return np.array(positions), np.clip(np.array(colours) + 0.5, 0, 255).astype(np.uint8), observations, errors


def check(scene, world, folder):
    """Checks that pictures, poses, points and tracks agree."""
    camera = world["camera"]
    poses, positions, colours, observations, tracks = read_model(folder / "sparse/0")
    pictures, rng = pictures_of(folder, len(poses)), np.random.default_rng(7)
    pairs = [(a, a + 1) for a in range(0, len(poses) - 1, 4)]
    shifts = np.array([misalignment(scene, camera, poses, pictures, a, b, 1500, rng) for a, b in pairs])
    print(f"texture shift between neighbouring views: mean {shifts.mean(0).round(3)}, largest {np.abs(shifts).max():.3f} pixel")
    errors, differences = [], []
    for k, rows in enumerate(observations):
        for x, y, point in rows:
            if point is None:
                continue
            if (k, rows.index((x, y, point))) not in tracks[point]:
                raise SystemExit(f"view {k}: a track of point {point} lacks it")
            p = camera.project(poses[k], positions[point])
            if p is not None:  # noise may move it over the edge
                errors.append(np.hypot(p[0] - x, p[1] - y))
            differences.append(
                np.abs(sample(pictures[k], np.clip((x, y), 1, (camera.width - 2, camera.height - 2))) - colours[point]).mean()
            )
    lengths = np.array([len(t) for t in tracks])
    distances = np.array([min(np.linalg.norm(positions[i] - centre_of(poses[k])) for k, _ in t) for i, t in enumerate(tracks)])
    print(
        f"{len(positions)} points, {lengths.mean():.1f} views each, {np.mean([sum(p is not None for *_, p in o) for o in observations]):.0f} points a view"
    )
    print(
        f"distance to the nearest camera: quartiles {np.percentile(distances, [25, 50, 75, 95]).round(1)}, {int((distances > 300).sum())} beyond 300"
    )
    print(
        f"points beside their observations: median {np.median(errors):.2f}, largest {np.max(errors):.2f} pixel; colours differ by {np.median(differences):.1f}/255"
    )
    if np.abs(shifts).max() > 0.2 or lengths.min() < 3 or np.median(errors) > 1:
        raise SystemExit("pictures, poses and points do not agree")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("folder", type=Path, help="output folder, for images/ and sparse/0/")
    parser.add_argument(
        "--spp",
        type=samples,
        default=256,
        help="samples per pixel (a square number); 64 leave noise of 3.5/255 (rms), four times as many halve it",
    )
    parser.add_argument("--only", type=int, nargs="*", help="render only these views as PNG into FOLDER, as a preview")
    parser.add_argument("--check", action="store_true", help="do not render, only check")
    arguments = parser.parse_args(arguments)
    ensure_outputs(arguments)
    start, folder = time.time(), arguments.folder
    world = SCENES[arguments.scene]()
    poses, camera = world["poses"], world["camera"]
    ensure_views(arguments.only, len(poses))
    scene = load(world)
    print(f"{sum(len(s['triangles']) for s in world['shapes'] + world.get('indoors', []))} triangles, {time.time() - start:.0f} s", flush=True)
    picture = photographer(scene, world, arguments.spp)
    if arguments.only is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for i in arguments.only:
            Image.fromarray(picture(i)).save(folder / f"{i:03d}.png")
        return
    if not arguments.check:
        take(picture, folder, len(poses), {"scene": arguments.scene, "spp": arguments.spp})
        points = sparse_points(scene, camera, poses, pictures_of(folder, len(poses)), np.random.default_rng(3))
        rendering.finish(folder, lambda model: write_model(model, camera, poses, *points))
    check(scene, world, folder)


if __name__ == "__main__":
    main()
