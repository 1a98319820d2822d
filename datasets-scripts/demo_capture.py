"""Renders the demo capture with Mitsuba 3 and writes it as JPEG pictures and a COLMAP binary model with exact poses.

    python demo_capture.py ../demo              # render everything and check it
    python demo_capture.py ../demo --check      # only check what is there

The variant scalar_rgb needs no LLVM. Everything is seeded; the same versions (requirements.txt) give the same pictures.
"""

import argparse
import struct
import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

import demo_scene

mi.set_variant("scalar_rgb")

WIDTH, HEIGHT = 224, 168
FOCAL = 288.0
# Off-centre on purpose: a reader that assumes the middle of the picture is wrong by 6 and 4 pixels.
PRINCIPAL = (WIDTH / 2 + 6.0, HEIGHT / 2 - 4.0)
VIEWS, ELEVATIONS, DISTANCE = 48, (11.0, 29.0, 50.0), 3.6
LOOK_AT = np.array([0.0, 0.0, 0.6])
POINTS, POINT_NOISE = 6000, 0.005
COLMAP_PINHOLE = 1


def intrinsics():
    return np.array([[FOCAL, 0, PRINCIPAL[0]], [0, FOCAL, PRINCIPAL[1]], [0, 0, 1]])


def view_pose(index):
    """World-to-camera rotation [3, 3] and translation [3], COLMAP axes: x right, y down, z forward.

    The azimuth advances steadily while the height cycles, so every eighth view (the test split) is spread over both.
    """
    rng = np.random.default_rng(1000 + index)
    azimuth = np.radians(360 * index / VIEWS + rng.uniform(-2, 2))
    elevation = np.radians(ELEVATIONS[index % 3] + rng.uniform(-3, 3))
    distance = DISTANCE * rng.uniform(0.95, 1.05)
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(right, back), -back])
    return rotation, -rotation @ (LOOK_AT + distance * back)


# ---------------------------------------------------------------- rendering


def write_ply(path, s):
    """Binary PLY with the property names Mitsuba expects."""
    columns, names = [s["positions"]], ["x", "y", "z"]
    if s["normals"] is not None:
        columns.append(s["normals"])
        names += ["nx", "ny", "nz"]
    columns.append(s["uvs"] * [1, -1] + [0, 1])  # Mitsuba's v runs down the picture
    names += ["u", "v"]
    faces = np.empty(len(s["triangles"]), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, s["triangles"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(s['positions'])}"]
    header += [f"property float {n}" for n in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(header).encode() + np.hstack(columns).astype("<f4").tobytes() + faces.tobytes())


def load_scene(shapes):
    texture = lambda s: {"type": "bitmap", "bitmap": mi.Bitmap(s["texture"]), "raw": False}
    world = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.76, 0.80, 0.87]}},
        "window": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([2.6, -2.2, 4.4], [0, 0, 0.4], [0, 0, 1]) @ mi.ScalarTransform4f().scale(1.3),
            "light": {"type": "area", "radiance": {"type": "rgb", "value": [10.4, 9.4, 7.9]}},
        },
    }
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


def render_view(scene, index, spp):
    """Linear radiance over black, encoded to sRGB uint8 [H, W, 3]."""
    rotation, translation = view_pose(index)
    to_world = np.eye(4)
    # Mitsuba's camera looks along +z with x to the left and y up.
    to_world[:3, :3] = rotation.T @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = -rotation.T @ translation
    sensor = mi.load_dict({
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))),
        "fov_axis": "x",
        "near_clip": 0.1,
        "far_clip": 20.0,
        # Mitsuba moves the picture, not the point: opposite signs (the check below would notice).
        "principal_point_offset_x": (WIDTH / 2 - PRINCIPAL[0]) / WIDTH,
        "principal_point_offset_y": (HEIGHT / 2 - PRINCIPAL[1]) / HEIGHT,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgba", "component_format": "float32",
                 "rfilter": {"type": "box"}},
        "sampler": {"type": "multijitter", "sample_count": spp, "seed": index},
    })
    # hide_emitters leaves what misses the scene black instead of showing the sky.
    integrator = mi.load_dict({"type": "path", "max_depth": 5, "hide_emitters": True})
    rgba = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=index), dtype=float)
    linear = np.clip(rgba[..., :3], 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


# ---------------------------------------------------------------- rays and points


def cast(scene, origin, direction):
    """Distance to the first surface along the unit direction, or infinity."""
    hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
    return float(hit.t) if hit.is_valid() else np.inf


def centre_of(rotation, translation):
    return -rotation.T @ translation


def pixel_ray(pose, pixel):
    """Unit direction in world space through pixel coordinates (the first pixel's centre is 0.5, 0.5)."""
    direction = pose[0].T @ np.linalg.solve(intrinsics(), [pixel[0], pixel[1], 1.0])
    return direction / np.linalg.norm(direction)


def project(pose, point):
    """Pixel coordinates, or None outside the picture."""
    x, y, z = intrinsics() @ (pose[0] @ point + pose[1])
    u, v = x / z, y / z
    return (u, v) if z > 0 and 1 <= u < WIDTH - 1 and 1 <= v < HEIGHT - 1 else None


def sample(picture, pixel):
    """Bilinear colour, float [3]."""
    x, y = pixel[0] - 0.5, pixel[1] - 0.5
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    block = picture[j : j + 2, i : i + 2].astype(float)
    return (block[0, 0] * (1 - fx) + block[0, 1] * fx) * (1 - fy) + (block[1, 0] * (1 - fx) + block[1, 1] * fx) * fy


def seen(scene, pose, point):
    """The point's pixel where the camera sees it unobstructed."""
    pixel = project(pose, point)
    if pixel is None:
        return None
    eye = centre_of(*pose)
    offset = point - eye
    distance = np.linalg.norm(offset)
    return pixel if cast(scene, eye, offset / distance) > distance - 2e-3 else None


def sparse_points(scene, poses, pictures, rng):
    """Surface points seen by at least three views: positions [P, 3] with noise as from SfM, median colours [P, 3]."""
    positions, colours = [], []
    while len(positions) < POINTS:
        pose = poses[rng.integers(len(poses))]
        direction = pixel_ray(pose, rng.uniform([1, 1], [WIDTH - 1, HEIGHT - 1]))
        eye = centre_of(*pose)
        distance = cast(scene, eye, direction)
        if not np.isfinite(distance):
            continue
        point = eye + distance * direction
        found = [sample(pictures[k], p) for k in range(len(poses)) if (p := seen(scene, poses[k], point)) is not None]
        if len(found) >= 3:
            positions.append(point + POINT_NOISE * rng.normal(size=3))
            colours.append(np.median(found, axis=0))
    return np.array(positions), np.clip(np.array(colours) + 0.5, 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- COLMAP model


def quaternion(r):
    """wxyz of a rotation matrix, w >= 0."""
    w, v = np.linalg.eigh(np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ]))
    q = v[:, np.argmax(w)]
    return q if q[0] >= 0 else -q


def rotation_of(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def name_of(index):
    return f"{index:03d}.jpg"


def write_model(folder, poses, positions, colours):
    """One shared PINHOLE camera; no 2-D observations, so the tracks are empty too."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = struct.pack("<QiiQQ4d", 1, 1, COLMAP_PINHOLE, WIDTH, HEIGHT, FOCAL, FOCAL, *PRINCIPAL)
    images = struct.pack("<Q", len(poses))
    for i, (rotation, translation) in enumerate(poses):
        images += struct.pack("<i7di", i + 1, *quaternion(rotation), *translation, 1) + name_of(i).encode() + b"\0" + struct.pack("<Q", 0)
    points = struct.pack("<Q", len(positions))
    for i, (xyz, rgb) in enumerate(zip(positions, colours)):
        points += struct.pack("<Q3d3BdQ", i + 1, *xyz, *rgb, 0.0, 0)
    for name, content in (("cameras.bin", camera), ("images.bin", images), ("points3D.bin", points)):
        (folder / name).write_bytes(content)


def read_model(folder):
    """Poses, point positions and colours of a model that write_model wrote."""
    data, poses, at = (folder / "images.bin").read_bytes(), [], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from("<i7di", data, at)
        at = data.index(b"\0", at + struct.calcsize("<i7di")) + 9
        poses.append((rotation_of(values[1:5]), np.array(values[5:8])))
    data = (folder / "points3D.bin").read_bytes()
    record = struct.Struct("<Q3d3BdQ")
    rows = [record.unpack_from(data, 8 + i * record.size) for i in range(struct.unpack_from("<Q", data)[0])]
    return poses, np.array([r[1:4] for r in rows]), np.array([r[4:7] for r in rows])


# ---------------------------------------------------------------- check


def misalignment(scene, poses, pictures, a, b, count, rng):
    """Shift in pixels at which picture b, carried to picture a over the true surface, fits best (least squares)."""
    rows, residuals = [], []
    while len(rows) < count:
        pixel = rng.integers([2, 2], [WIDTH - 2, HEIGHT - 2]) + 0.5
        direction = pixel_ray(poses[a], pixel)
        eye = centre_of(*poses[a])
        distance = cast(scene, eye, direction)
        if not np.isfinite(distance):
            continue
        other = seen(scene, poses[b], eye + distance * direction)
        if other is None or not (2 <= other[0] < WIDTH - 2 and 2 <= other[1] < HEIGHT - 2):
            continue
        step = lambda dx, dy: sample(pictures[b], (other[0] + dx, other[1] + dy))
        gx, gy = (step(0.5, 0) - step(-0.5, 0)), (step(0, 0.5) - step(0, -0.5))
        rows += list(zip(gx, gy))
        residuals += list(sample(pictures[a], pixel) - step(0, 0))
    rows, residuals = np.array(rows), np.array(residuals)
    keep = np.abs(residuals) < 60  # silhouettes mix colours of two surfaces
    return np.linalg.lstsq(rows[keep], residuals[keep], rcond=None)[0]


def outline_error(scene, pose, picture, offset):
    """Share of pixels whose ray hits the scene but which are black, or the other way round; rays moved by offset pixels."""
    ys, xs = np.mgrid[0:HEIGHT, 0:WIDTH:2]
    wrong = 0
    for x, y in zip(xs.ravel(), ys.ravel()):
        hit = np.isfinite(cast(scene, centre_of(*pose), pixel_ray(pose, (x + 0.5 + offset[0], y + 0.5 + offset[1]))))
        wrong += hit != (picture[y, x].max() > 24)
    return wrong / xs.size


def check(scene, folder):
    """Poses, intrinsics and pictures agree: outlines, texture carried from view to view, colours at projected points."""
    poses, positions, colours = read_model(folder / "sparse/0")
    pictures = [np.asarray(Image.open(folder / "images" / name_of(i))) for i in range(len(poses))]
    rng = np.random.default_rng(7)

    offsets = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
    outline = {o: np.mean([outline_error(scene, poses[k], pictures[k], o) for k in (4, 23)]) for o in offsets}
    print("outline pixels that differ, by shift:", ", ".join(f"{o} {100 * e:.2f} %" for o, e in outline.items()))
    shifts = np.array([misalignment(scene, poses, pictures, a, (a + 1) % len(poses), 1500, rng) for a in range(0, len(poses), 4)])
    print(f"texture shift between neighbouring views: mean {shifts.mean(0).round(3)}, largest {np.abs(shifts).max():.3f} pixel")
    errors = []
    for _ in range(4000):
        k, p = rng.integers(len(poses)), rng.integers(len(positions))
        pixel = seen(scene, poses[k], positions[p])
        if pixel is not None:
            errors.append(np.abs(sample(pictures[k], pixel) - colours[p]).mean())
    print(f"colour difference at {len(errors)} projected points: median {np.median(errors):.1f}/255")
    if min(outline, key=outline.get) != (0, 0) or np.abs(shifts).max() > 0.2:
        raise SystemExit("pictures and poses do not agree")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="where images/ and sparse/0/ go")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel (a square number)")
    parser.add_argument("--only", type=int, nargs="*", help="render these views as PNG into FOLDER and stop (for a look)")
    parser.add_argument("--check", action="store_true", help="do not render, only check")
    arguments = parser.parse_args()
    scene = load_scene(demo_scene.build())
    folder = arguments.folder
    if arguments.only is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for i in arguments.only:
            Image.fromarray(render_view(scene, i, arguments.spp)).save(folder / f"{i:03d}.png")
        return
    if not arguments.check:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        start = time.time()
        for i in range(VIEWS):
            Image.fromarray(render_view(scene, i, arguments.spp)).save(folder / "images" / name_of(i), quality=95, subsampling=0)
            print(f"view {i + 1}/{VIEWS}, {time.time() - start:.0f} s", flush=True)
        poses = [view_pose(i) for i in range(VIEWS)]
        pictures = [np.asarray(Image.open(folder / "images" / name_of(i))) for i in range(VIEWS)]
        write_model(folder / "sparse/0", poses, *sparse_points(scene, poses, pictures, np.random.default_rng(3)))
    check(scene, folder)


if __name__ == "__main__":
    main()
