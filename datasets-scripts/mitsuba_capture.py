"""Shapes of procedural.py and cameras of colmap_model.py in Mitsuba 3: pictures and rays.

The variant scalar_rgb needs no LLVM. Everything is seeded; the same versions (requirements.txt) give the same pictures.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import PIL
from PIL import Image

import rendering
from colmap_model import centre_of, name_of
from outputs import ensure_folder

mi.set_variant("scalar_rgb")

LARGEST_SPP = 65_536


def samples(text):
    """Parses --spp. Mitsuba divides by it, which crashes at 0, and values near 2^32 overflow to 0."""
    if not (text.isascii() and text.isdigit() and len(text) < 10 and 0 < int(text) <= LARGEST_SPP):
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {LARGEST_SPP}, found {text or 'nothing'}")
    return int(text)


def ensure_outputs(arguments):
    """Stops unless the outputs can be written, or with --check exist: building a scene takes a while."""
    folder = arguments.folder
    try:
        if arguments.only is not None:
            ensure_folder(folder)
        elif not arguments.check:
            ensure_folder(folder / "images")
            ensure_folder(folder / "sparse/0")
        elif not (folder / "sparse/0/images.bin").is_file():
            raise OSError(f"{folder}: expected a capture to check, found none")
    except OSError as error:
        sys.exit(f"error: {error}")


def ensure_views(only, views):
    """Stops if --only names a view that does not exist."""
    for i in only or ():
        if not 0 <= i < views:
            sys.exit(f"error: --only: expected views from 0 to {views - 1}, found {i}")


def write_ply(path, s):
    """Binary PLY with the property names Mitsuba expects."""
    columns, names = [s["positions"]], ["x", "y", "z"]
    if s["normals"] is not None:
        columns.append(s["normals"])
        names += ["nx", "ny", "nz"]
    columns.append(s["uvs"] * [1, -1] + [0, 1])  # Mitsuba's v points down the picture
    names += ["u", "v"]
    faces = np.empty(len(s["triangles"]), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, s["triangles"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(s['positions'])}"]
    header += [f"property float {n}" for n in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(header).encode() + np.hstack(columns).astype("<f4").tobytes() + faces.tobytes())


def load_scene(shapes, emitters):
    texture = lambda s: {"type": "bitmap", "bitmap": mi.Bitmap(s["texture"]), "raw": False}
    world = {"type": "scene", **emitters}
    with tempfile.TemporaryDirectory() as folder:
        for i, s in enumerate(shapes):
            path = Path(folder) / f"{i}.ply"
            write_ply(path, s)
            if s["gloss"] > 0:
                bsdf = {"type": "roughplastic", "alpha": 0.22, "int_ior": 1.38, "nonlinear": True, "diffuse_reflectance": texture(s)}
            else:
                bsdf = {"type": "diffuse", "reflectance": texture(s)}
            world[f"shape{i}"] = {"type": "ply", "filename": str(path), "bsdf": {"type": "twosided", "bsdf": bsdf}}
        return mi.load_dict(world)


def render(scene, camera, pose, spp, seed, near_far, hide_emitters):
    """Linear radiance encoded to sRGB uint8 [H, W, 3]; rays that miss the scene are black with hide_emitters, else
    sky."""
    return encoded(radiance(scene, camera, pose, spp, seed, near_far, hide_emitters)[..., :3])


def encoded(linear):
    """Encodes as sRGB uint8 [H, W, 3]."""
    linear = np.clip(linear, 0, 1)
    picture = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (picture * 255 + 0.5).astype(np.uint8)


def radiance(scene, camera, pose, spp, seed, near_far, hide_emitters, depth=5):
    """Linear radiance and coverage [H, W, 4], premultiplied; light paths have at most `depth` segments from lamp to
    eye."""
    to_world = np.eye(4)
    # Mitsuba's camera looks along +z with x to the left and y up.
    to_world[:3, :3] = pose[0].T @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = centre_of(pose)
    width, height = camera.width, camera.height
    sensor = mi.load_dict({
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(width / 2 / camera.focal))),
        "fov_axis": "x",
        "near_clip": near_far[0],
        "far_clip": near_far[1],
        # Mitsuba shifts the picture, not the point, hence opposite signs (the scripts' checks would detect an error).
        "principal_point_offset_x": (width / 2 - camera.principal[0]) / width,
        "principal_point_offset_y": (height / 2 - camera.principal[1]) / height,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba", "component_format": "float32",
                 "rfilter": {"type": "box"}},
        "sampler": {"type": "multijitter", "sample_count": spp, "seed": seed},
    })
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": hide_emitters})
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed), dtype=float)


def take(picture, folder, views, settings):
    """Renders `views` views with `picture(i)`; pictures left by an interrupted run with the same settings are kept."""
    start = time.time()
    versions = {module.__name__: module.__version__ for module in (mi, np, PIL)}

    def save(i, path):
        Image.fromarray(picture(i)).save(path, quality=95, subsampling=0)
        print(f"view {i + 1}/{views}, {time.time() - start:.0f} s", flush=True)

    try:
        rendering.pictures(folder, [name_of(i) for i in range(views)], {**settings, **versions}, save)
    except OSError as error:
        sys.exit(f"error: {error}")


def pictures_of(folder, views):
    return [np.asarray(Image.open(folder / "images" / name_of(i))) for i in range(views)]


def cast(scene, origin, direction):
    """Distance to the first surface along the unit direction, or infinity."""
    hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
    return float(hit.t) if hit.is_valid() else np.inf


def seen(scene, camera, pose, point, tolerance=2e-3):
    """Pixel of a point if the camera sees it unoccluded."""
    pixel = camera.project(pose, point)
    if pixel is None:
        return None
    eye = centre_of(pose)
    offset = point - eye
    distance = np.linalg.norm(offset)
    return pixel if cast(scene, eye, offset / distance) > distance - tolerance else None


def sample(picture, pixel):
    """Bilinearly interpolated colour, float [3]."""
    x, y = pixel[0] - 0.5, pixel[1] - 0.5
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    block = picture[j : j + 2, i : i + 2].astype(float)
    return (block[0, 0] * (1 - fx) + block[0, 1] * fx) * (1 - fy) + (block[1, 0] * (1 - fx) + block[1, 1] * fx) * fy


def misalignment(scene, camera, poses, pictures, a, b, count, rng, tolerance=2e-3):
    """Shift in pixels at which picture b, transferred to picture a over the true surface, fits best (least squares)."""
    rows, residuals = [], []
    eye = centre_of(poses[a])
    while len(rows) < count:
        pixel = rng.integers([2, 2], [camera.width - 2, camera.height - 2]) + 0.5
        direction = camera.ray(poses[a], pixel)
        distance = cast(scene, eye, direction)
        if not np.isfinite(distance):
            continue
        other = seen(scene, camera, poses[b], eye + distance * direction, tolerance * max(1, distance))
        if other is None or not (2 <= other[0] < camera.width - 2 and 2 <= other[1] < camera.height - 2):
            continue
        step = lambda dx, dy: sample(pictures[b], (other[0] + dx, other[1] + dy))
        gx, gy = (step(0.5, 0) - step(-0.5, 0)), (step(0, 0.5) - step(0, -0.5))
        rows += list(zip(gx, gy))
        residuals += list(sample(pictures[a], pixel) - step(0, 0))
    rows, residuals = np.array(rows), np.array(residuals)
    keep = np.abs(residuals) < 60  # silhouettes mix the colours of two surfaces
    return np.linalg.lstsq(rows[keep], residuals[keep], rcond=None)[0]
