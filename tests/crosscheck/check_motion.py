#!/usr/bin/env python3
"""Whether scenes that move are in Blender where Centaur has them: python check_motion.py CENTAUR FOLDER SCENE...

Runs under a Python that has bpy. Of each scene the .blend.py is run and saved, the .blend opened, and at three frames of it every vertex
compared with `centaur convert --time`: the largest distance must be at most 1e-5 of the scene's extent.
"""
import json
import pathlib
import shlex
import subprocess
import sys

import bpy
import numpy as np

LIMIT = 1e-5


def surfaces(script):
    """Vertices of every mesh beside a script: x y z s t of 32 bits each."""
    found = []
    stem = script.name.removesuffix(".blend.py") + "_mesh"
    number = lambda path: int(path.stem.removeprefix(stem))
    for path in sorted(script.parent.glob(f"{stem}*.ply"), key=number):
        header, data = path.read_bytes().split(b"end_header\n", 1)
        count = int(header.split(b"element vertex ")[1].split()[0])
        found.append(np.frombuffer(data, "<f4", 5 * count).reshape(-1, 5)[:, :3].astype(np.float64))
    return found


def in_blender():
    """The same of the meshes of an open .blend, at its frame."""
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


def main():
    centaur, folder, *scenes = sys.argv[1:]
    if not scenes:
        sys.exit("check_motion.py: expected scenes, found none")
    centaur, folder = shlex.split(centaur), pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    run = lambda *command: subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL)
    errors = []
    for scene in map(pathlib.Path, scenes):
        script, blend = folder / f"{scene.stem}.blend.py", folder / f"{scene.stem}.blend"
        run(*centaur, "convert", scene, script, "--quiet")
        run(sys.executable, script, "--save", blend)
        text = script.read_text()
        motion = json.loads(text.split("SCENE = json.loads(r'''")[1].split("''')\n")[0])["motion"]
        for frame in sorted({1, 1 + motion["frames"] // 3, motion["frames"] - 1}):
            time = motion["start"] + (frame - 1) / motion["fps"]
            posed = folder / f"{scene.stem}-{frame}.blend.py"
            run(*centaur, "convert", scene, posed, "--time", repr(time), "--quiet")
            # Opened anew, as reading the scene before it has closed all others.
            bpy.ops.wm.open_mainfile(filepath=str(blend), use_scripts=False)
            bpy.context.scene.frame_set(frame)
            ours, theirs = surfaces(posed), in_blender()
            extent = np.ptp(np.concatenate(ours), axis=0).max()
            apart = [np.abs(a - b).max() if a.shape == b.shape else np.inf for a, b in zip(ours, theirs, strict=True)]
            # Unlike `max`, numpy's keeps what is not a number.
            error = np.max(apart) / extent
            errors.append(error)
            print(f"{scene.stem} at {time:.3f} s (frame {frame}): {sum(map(len, ours))} vertices, {error:.1e} of the extent")
    worst = np.max(errors)
    print(f"Blender {bpy.app.version_string}: {worst:.1e} of the extent at most, {LIMIT:.0e} is allowed")
    sys.exit(int(not worst <= LIMIT))


if __name__ == "__main__":
    main()
