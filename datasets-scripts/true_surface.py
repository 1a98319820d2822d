"""The smooth surfaces of a scene of this folder, as one PLY in the frame of its capture: what a surface made of it is compared with.

    python3 datasets-scripts/true_surface.py demo truth.ply
    centaur mesh demo -o surface.glb --truth truth.ply
    python3 datasets-scripts/true_surface.py garden truth.ply        # or room, street; needs numpy and pillow
    centaur mesh target/unbounded/garden -o surface.glb --truth truth.ply
"""

import sys
from pathlib import Path

import numpy as np

import demo_scene
from procedural import merged
from unbounded_garden import garden
from unbounded_room import room
from unbounded_street import street

SCENES = {
    "demo": demo_scene.build,
    "garden": lambda: garden()["shapes"],
    "room": lambda: room()["shapes"] + room()["indoors"],
    "street": lambda: street()["shapes"],
}


def main(scene, path):
    smooth = [s for s in SCENES[scene]() if not s["grows"]]
    positions, _, triangles = merged([(s["positions"], s["uvs"], s["triangles"]) for s in smooth])
    faces = np.empty(len(triangles), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    header += [f"property float {n}" for n in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    Path(path).write_bytes("\n".join(header).encode() + positions.astype("<f4").tobytes() + faces.tobytes())
    print(f"{path}: {len(triangles)} triangles")


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in SCENES:
        sys.exit(__doc__)
    main(*sys.argv[1:])
