"""The smooth surfaces of the demo scene, as one PLY in the frame of the capture: what a surface made of it is compared with.

    python3 datasets-scripts/demo_truth.py truth.ply
    centaur mesh demo -o surface.glb --truth truth.ply
"""

import sys
from pathlib import Path

import numpy as np

from demo_scene import build


def main(path):
    # What grows has no normals of its own.
    smooth = [s for s in build() if s["normals"] is not None]
    starts = np.cumsum([0] + [len(s["positions"]) for s in smooth])
    positions = np.concatenate([s["positions"] for s in smooth]).astype("<f4")
    triangles = np.concatenate([s["triangles"] + start for s, start in zip(smooth, starts)])
    faces = np.empty(len(triangles), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    header += [f"property float {n}" for n in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    Path(path).write_bytes("\n".join(header).encode() + positions.tobytes() + faces.tobytes())
    print(f"{path}: {len(triangles)} triangles")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
