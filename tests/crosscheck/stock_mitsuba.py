#!/usr/bin/env python3
"""Renders a `.stock.xml` with unmodified Mitsuba: python stock_mitsuba.py SCENE.stock.xml OUT.exr CAMERA

It uses only Mitsuba's own plug-ins; the film has no alpha.
"""
import pathlib
import sys

if __name__ == "__main__":
    # Imported for its choice of LLVM and variant; its plug-ins are not registered.
    sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "src/format/mitsuba"))
    import hybrid_rf  # noqa: F401
    import mitsuba as mi

    scene, out, camera = sys.argv[1], sys.argv[2], int(sys.argv[3])
    mi.Bitmap(mi.render(mi.load_file(scene), sensor=camera)).write(out)
