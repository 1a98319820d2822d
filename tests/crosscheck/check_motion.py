#!/usr/bin/env python3
"""Checks that animated scenes in Blender match Centaur: python check_motion.py CENTAUR FOLDER SCENE...

Runs under a Python that has bpy. For each scene, and for one with splats on a node that is stretched, the .blend.py is
run and saved, the .blend opened, and at three frames every vertex and splat is compared with `centaur convert --time`:
the largest distance must be at most 1e-5 of the scene's extent, and covariances must agree within 1e-5 of their largest
entry. Splats must also be there if meshes are not shown. In the rest position of an armature, vertices must be on average
within a tenth of the extent of where they are without an animation. A picture of a texture on a node that is moved and
scaled must match the one without motion, which is known to be filtered correctly, within 60 dB.
"""
import base64
import json
import pathlib
import shlex
import subprocess
import sys

import bpy
import numpy as np

LIMIT = 1e-5
LEAST_PSNR = 60
MOST_AT_REST = 0.1


def write_stretched(path):
    """Writes 30 splats on a rotated node that grows along one axis, shrinks along another and is finally mirrored."""
    random, n, khr = np.random.default_rng(0), 30, "KHR_gaussian_splatting"
    rotations = random.normal(size=(n, 4))
    arrays = [
        random.normal(size=(n, 3)), rotations / np.linalg.norm(rotations, axis=1, keepdims=True), random.uniform(0.01, 0.5, (n, 3)),
        random.uniform(0.1, 0.9, n), random.normal(size=(n, 3)), [0, 1, 2], [[1, 1, 1], [1, 2, 0.5], [2, 1, -1]],
    ]
    arrays = [np.asarray(array, np.float32) for array in arrays]
    names = ["POSITION", *(f"{khr}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))]
    extension = {khr: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    document = {
        "extensionsUsed": [khr], "scenes": [{"nodes": [0]}],
        "nodes": [{"rotation": [0.5, 0.5, 0.1, 0.7], "children": [1]}, {"rotation": [0.2, -0.4, 0.6, 0.7], "mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {name: i for i, name in enumerate(names)}, "extensions": extension}]}],
        "animations": [{"samplers": [{"input": 5, "output": 6}], "channels": [{"sampler": 0, "target": {"node": 1, "path": "scale"}}]}],
    }
    write_gltf(path, document, arrays)


def write_quad(path):
    """Writes a quad with a texture finer than pixels on a rotated node, which moves and has scales far from 1 and from
    each other."""
    image = bpy.data.images.new("noise", 128, 128)
    texels = np.ones((128, 128, 4), np.float32)
    texels[..., :3] = np.random.default_rng(0).uniform(size=(128, 128, 3))
    image.pixels.foreach_set(texels.ravel())
    image.filepath_raw, image.file_format = str(path.with_suffix(".png")), "PNG"
    image.save()
    scale = np.array([0.01, 0.07, 0.003])
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / scale
    arrays = [corners, [[0, 1], [1, 1], [1, 0], [0, 0]], [0, 1], [[0, 0, -4], [0.3, 0.1, -5]]]
    arrays = [np.asarray(array, np.float32) for array in arrays] + [np.array([0, 1, 2, 0, 2, 3], np.uint32)]
    document = {
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "scale": scale.tolist(), "rotation": [0.2, -0.5, 0.1, 0.83667]}, {"camera": 0}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1, "aspectRatio": 1}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 4, "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": path.with_suffix(".png").name}],
        "animations": [{"samplers": [{"input": 2, "output": 3}], "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]}],
    }
    write_gltf(path, document, arrays)


def write_gltf(path, document, arrays):
    """Writes a glTF with an accessor for each array of floats or indices."""
    ends = np.cumsum([array.nbytes for array in arrays])
    kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
    content = base64.b64encode(b"".join(array.tobytes() for array in arrays)).decode()
    document |= {
        "asset": {"version": "2.0"},
        "accessors": [{"bufferView": i, "componentType": 5126 if array.dtype == np.float32 else 5125, "count": len(array),
                       "type": kinds[array[0].size], "min": np.atleast_1d(array.min(0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
                      for i, array in enumerate(arrays)],
        "bufferViews": [{"buffer": 0, "byteOffset": int(end) - array.nbytes, "byteLength": array.nbytes} for array, end in zip(arrays, ends)],
        "buffers": [{"byteLength": int(ends[-1]), "uri": f"data:application/octet-stream;base64,{content}"}],
    }
    path.write_text(json.dumps(document))


def splats(script):
    """Means and covariances of the splats beside a script."""
    path = script.with_name(script.name.removesuffix(".blend.py") + "_splats.ply")
    if not path.exists():
        return np.empty((0, 3)), np.empty((0, 3, 3))
    header, data = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names)).astype(np.float64)
    get = lambda *columns: np.stack([rows[:, names.index(column)] for column in columns], 1)
    w, x, y, z = get("rot_0", "rot_1", "rot_2", "rot_3").T
    axes = np.moveaxis(np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                                 [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                                 [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]), -1, 0)
    axes = axes * np.exp(get("scale_0", "scale_1", "scale_2"))[:, None]
    return get("x", "y", "z"), axes @ axes.transpose(0, 2, 1)


def functions_of(script):
    """Functions defined by a script, by name."""
    functions = {"__name__": script.name, "__file__": str(script)}
    exec(compile(script.read_text(), script.name, "exec"), functions)
    return functions


def build(script, *arguments):
    """Runs a script here, in a new file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    functions = functions_of(script)
    functions["run"](functions["parse"]([str(a) for a in arguments]))
    functions["listen"](False)  # Python does not end while handlers are registered


def splats_in_blender(script):
    """Means and covariances of the splats in an open .blend, at its frame, by the functions of its script."""
    functions = functions_of(script)
    root, _ = functions["find_root"]()
    data = next((c for c in root.children if c.get("centaur") == "splat data"), None)
    if data is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    found = functions["followed"](functions["carried"](data.data), root, data.data, None)
    axes = found.axes() * found.scale[:, None]
    return found.mean, axes @ axes.transpose(0, 2, 1)


def surfaces(script):
    """Vertices of every mesh beside a script: x y z s t with 32 bits each."""
    found = []
    stem = script.name.removesuffix(".blend.py") + "_mesh"
    number = lambda path: int(path.stem.removeprefix(stem))
    for path in sorted(script.parent.glob(f"{stem}*.ply"), key=number):
        header, data = path.read_bytes().split(b"end_header\n", 1)
        count = int(header.split(b"element vertex ")[1].split()[0])
        found.append(np.frombuffer(data, "<f4", 5 * count).reshape(-1, 5)[:, :3].astype(np.float64))
    return found


def in_blender():
    """Vertices of the meshes in an open .blend, at its frame."""
    root = next(o for o in bpy.context.scene.objects if str(o.get("centaur", "")).startswith("{"))
    depsgraph, found = bpy.context.evaluated_depsgraph_get(), {}
    for thing in root.children:
        if thing.get("centaur") == "mesh":
            evaluated = thing.evaluated_get(depsgraph)
            mesh = evaluated.to_mesh()
            points = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", points)
            matrix = np.array(root.evaluated_get(depsgraph).matrix_world.inverted() @ evaluated.matrix_world)
            found[thing["index"]] = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
            evaluated.to_mesh_clear()
    return [found[i] for i in sorted(found)]


def resting_error(script):
    """Mean distance, relative to the extent, between the meshes of an open .blend in the rest position of its armature
    and those beside its script; 0 where there is no armature."""
    for armature in bpy.data.armatures:
        armature.pose_position = "REST"
    bpy.context.view_layer.update()
    skinned = {thing["index"] for thing in bpy.data.objects if any(m.type == "ARMATURE" for m in thing.modifiers)}
    pairs = [(a, b) for i, (a, b) in enumerate(zip(surfaces(script), in_blender(), strict=True)) if i in skinned]
    return max((np.linalg.norm(a - b, axis=1).mean() / np.ptp(a, axis=0).max() for a, b in pairs), default=0.0)


def picture(script):
    """RGBA [h, w, 4] of an open .blend, at a tenth of its size."""
    functions = functions_of(script)
    bpy.context.scene.render.resolution_percentage = 10
    functions["refresh"]()
    channels = functions["render_picture"](False)
    return np.stack([channels[c] for c in "RGBA"], -1)


def psnr_of_quad(run, centaur, folder):
    """PSNR between pictures of the moving and the resting quad."""
    scene, script, still = (folder / name for name in ("quad.gltf", "quad.blend.py", "quad-still.blend.py"))
    write_quad(scene)
    run(*centaur, "convert", scene, script, "--quiet")
    run(*centaur, "convert", scene, still, "--time", 0.5, "--quiet")
    build(script)
    bpy.context.scene.frame_set(16)
    moving = picture(script)
    build(still)
    error = moving - picture(still)
    return -10 * np.log10(np.mean(error[moving[..., 3] > 0] ** 2) + 1e-30)


def main():
    centaur, folder, *scenes = sys.argv[1:]
    if not scenes:
        sys.exit("check_motion.py: expected scenes, found none")
    centaur, folder = shlex.split(centaur), pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    run = lambda *command: subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL)
    write_stretched(folder / "stretched.gltf")
    errors, resting = [], 0.0
    for scene in [folder / "stretched.gltf", *map(pathlib.Path, scenes)]:
        script, blend = folder / f"{scene.stem}.blend.py", folder / f"{scene.stem}.blend"
        run(*centaur, "convert", scene, script, "--quiet")
        run(sys.executable, script, "--save", blend)
        text = script.read_text()
        motion = json.loads(text.split("SCENE = json.loads(r'''")[1].split("''')\n")[0])["motion"]
        for frame in sorted({1, 1 + motion["frames"] // 3, motion["frames"] - 1}):
            time = motion["start"] + (frame - 1) / motion["fps"]
            posed = folder / f"{scene.stem}-{frame}.blend.py"
            run(*centaur, "convert", scene, posed, "--time", repr(time), "--quiet")
            # Opened again, since reading the previous scene has closed all others.
            bpy.ops.wm.open_mainfile(filepath=str(blend), use_scripts=False)
            bpy.context.scene.frame_set(frame)
            ours, theirs = surfaces(posed), in_blender()
            (means, shapes), (their_means, their_shapes) = splats(posed), splats_in_blender(script)
            if len(means) and len(ours) and frame > 1:
                build(script, "--what", "splats")
                bpy.context.scene.frame_set(frame)
                ours, theirs = [*ours, means], [*theirs, splats_in_blender(script)[0]]
            ours, theirs = [*ours, means], [*theirs, their_means]
            extent = np.ptp(np.concatenate(ours), axis=0).max()
            apart = [np.abs(a - b).max(initial=0) if a.shape == b.shape else np.inf for a, b in zip(ours, theirs, strict=True)]
            # Unlike `max`, numpy's maximum propagates NaN.
            error = np.max(apart) / extent
            stretched = np.abs(shapes - their_shapes).max((1, 2)) / np.abs(shapes).max((1, 2))
            errors += [error, stretched.max(initial=0)]
            print(f"{scene.stem} at {time:.3f} s (frame {frame}): {sum(map(len, ours))} vertices and splats, {error:.1e} of the extent, "
                  f"covariances {errors[-1]:.1e}")
        bpy.ops.wm.open_mainfile(filepath=str(blend), use_scripts=False)
        resting = max(resting, resting_error(script))
    worst, psnr = np.max(errors), psnr_of_quad(run, centaur, folder)
    print(f"Blender {bpy.app.version_string}: {worst:.1e} at most, {LIMIT:.0e} is allowed")
    print(f"in the rest position {resting:.1e} of the extent on average, {MOST_AT_REST} is allowed")
    print(f"a texture on a node that moves: {psnr:.1f} dB from one that does not, {LEAST_PSNR} is asked for")
    sys.exit(int(not (worst <= LIMIT and resting <= MOST_AT_REST and psnr >= LEAST_PSNR)))


if __name__ == "__main__":
    main()
