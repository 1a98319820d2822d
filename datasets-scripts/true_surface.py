"""Writes the smooth surfaces of a scene of this folder as a PLY in the frame of its capture, as ground truth for
reconstructed surfaces.

    python3 datasets-scripts/true_surface.py demo truth.ply          # needs numpy and pillow
    centaur mesh demo -o surface.glb --truth truth.ply
    python3 datasets-scripts/true_surface.py garden truth.ply        # or room, street
    centaur mesh target/unbounded/garden -o surface.glb --truth truth.ply
"""

import argparse
import importlib
import sys
from pathlib import Path

from outputs import ensure_file, write_whole

SCENES = ("demo", "garden", "room", "street")


def shapes(scene):
    if scene == "demo":
        return importlib.import_module("demo_scene").build()
    world = getattr(importlib.import_module(f"unbounded_{scene}"), scene)()
    return world["shapes"] + world.get("indoors", [])


def surface(scene):
    """Chunks of the PLY in bytes, and its number of triangles."""
    import numpy as np

    from procedural import merged

    smooth = [s for s in shapes(scene) if not s["grows"]]
    positions, _, triangles = merged([(s["positions"], s["uvs"], s["triangles"]) for s in smooth])
    faces = np.empty(len(triangles), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    header += [f"property float {n}" for n in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    return ["\n".join(header).encode(), positions.astype("<f4").tobytes(), faces.tobytes()], len(triangles)


def ply(name):
    if not name.lower().endswith(".ply"):
        raise argparse.ArgumentTypeError(f"expected a name that ends in .ply, found {name}")
    return Path(name)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("output", type=ply, help="file to write, .ply")
    args = parser.parse_args(arguments)
    try:
        ensure_file(args.output)
        parts, triangles = surface(args.scene)
        write_whole(args.output, parts)
    except ImportError as error:
        sys.exit(f"error: {error}; install it with: pip install numpy pillow")
    except OSError as error:
        sys.exit(f"error: {error}")
    print(f"{args.output}: {triangles} triangles")


if __name__ == "__main__":
    main()
