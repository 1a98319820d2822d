#!/usr/bin/env python3
"""Checks our files in Blender: check_blender.py CENTAUR HYBRID.glb FOLDER, run by a Python that has `bpy`.

* `centaur convert HYBRID.glb scene.blend.py`: the script renders, saves, and reports errors in one line.
* Flat splats are visible in every construction.
* A saved .blend rebuilds its splats when its camera moves, for animations and for stills.
* Run again in the text editor, the script replaces what it has built; the text that it stores builds nothing.
* The stock importer reads HYBRID.glb: only the splats' shapes are lost, and the mesh looks as ours does in linear
light.

The accuracy of pictures is checked elsewhere, with renderers that are independent of Blender. Every check runs in a
separate process, since `bpy` can be imported only once.
"""
import json
import pathlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys

import numpy as np


def psnr(a, b):
    return -10 * np.log10(np.maximum(np.mean((a - b) ** 2), 1e-30))


def run(command, expect=0):
    done = subprocess.run([str(c) for c in command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True, timeout=300)
    assert done.returncode == expect, f"{command}: exit code {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done


def inside(step, *arguments):
    """Runs a step of this file in a separate process; returns its result, passed as JSON."""
    done = run([sys.executable, __file__, f"--{step}", *arguments])
    return json.loads(done.stdout.split("RESULT ", 1)[1].splitlines()[0])


# --- steps, each in a separate process ---

def read_picture(path):
    """Reads an EXR as [h, w, 4], from the top."""
    import bpy
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def write_exr_to(path):
    import bpy
    form = bpy.context.scene.render.image_settings
    if hasattr(form, "media_type"):
        form.media_type = "IMAGE"
    form.file_format, form.color_depth, form.color_mode = "OPEN_EXR", "32", "RGBA"
    bpy.context.scene.render.filepath = str(path)


def step_compare(a, b):
    a, b = read_picture(a), read_picture(b)
    return {"psnr": psnr(a, b), "seen": int((b[..., 3] > 0.5).sum())}


def step_import(glb, picture):
    """The stock importer's scene, rendered with our settings of Cycles, its points hidden."""
    import bpy
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=glb)
    scene = bpy.context.scene
    things = [(o.type, len(o.data.vertices), len(o.data.polygons)) for o in bpy.data.objects if o.type == "MESH"]
    for thing in bpy.data.objects:
        thing.hide_render = thing.type == "MESH" and not thing.data.polygons
    scene.camera = next(o for o in bpy.data.objects if o.type == "CAMERA")
    render, cycles = scene.render, scene.cycles
    render.engine, render.film_transparent, render.dither_intensity = "CYCLES", True, 0
    render.resolution_x, render.resolution_y = 640, 480
    scene.view_settings.view_transform = "Raw"
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = 1, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01
    cycles.transparent_max_bounces = cycles.min_transparent_bounces = 64
    write_exr_to(picture)
    bpy.ops.render.render(write_still=True)
    return {"meshes": things, "cameras": sum(o.type == "CAMERA" for o in bpy.data.objects)}


def step_own(script, blend, picture):
    """Renders in a file whose own settings would give another picture."""
    import bpy
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.use_multiview, scene.render.use_border, scene.render.resolution_percentage = True, True, 50
    scene.render.border_max_x, scene.render.use_crop_to_border = 0.5, True
    scene.cycles.film_exposure, scene.view_settings.use_curve_mapping = 2, True
    layer.material_override, layer.samples = bpy.data.materials.new("clay"), 4
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    sys.argv = [script, "--render", picture]
    runpy.run_path(script, run_name="__main__")
    return {}


def step_reopen(blend, folder):
    """Opens a saved .blend, renders two frames of its path, moves the camera, renders a still, and again after splats
    have changed."""
    import bpy
    bpy.ops.wm.open_mainfile(filepath=blend, use_scripts=True)
    scene = bpy.context.scene
    shown = lambda: next(o for o in scene.objects if o.get("centaur") == "splats")["built for"]
    states = [shown()]
    scene.frame_start, scene.frame_end = 2, 3
    write_exr_to(f"{folder}/frame_####.exr")
    bpy.ops.render.render(animation=True)
    states.append(shown())
    scene.camera = next(o for o in scene.objects if o.get("centaur") == "camera")
    scene.camera.location.x += 0.25
    write_exr_to(f"{folder}/still.exr")
    bpy.ops.render.render(write_still=True)
    states.append(shown())
    bpy.ops.render.render(write_still=True)
    unchanged = shown() == states[-1]
    attributes = next(o for o in bpy.data.objects if o.get("centaur") == "splat data").data.attributes
    names = sorted(a.name for a in attributes)
    for name, values in (("scale", "vector"), ("radiance:base", "color"), ("radiance:sh_0", "vector")):
        getattr(attributes[name].data[0], values)[0] *= 1.5
        bpy.ops.render.render(write_still=True)
        states.append(shown())
    for handlers in (bpy.app.handlers.frame_change_post, bpy.app.handlers.render_init):
        handlers.clear()  # Python does not end while they are registered
    return {"states": len(set(states)), "unchanged": unchanged, "attributes": names}


def step_text(script, blend):
    """Runs the script twice as a text of a file, the second time with another near plane, and opens that file with
    another scene."""
    import bpy
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    sys.argv = [script]
    bpy.data.texts.new("another.py").from_string("def find_root(): pass")
    text = bpy.data.texts.load(script)

    def run_text():
        with bpy.context.temp_override(edit_text=text):
            bpy.ops.text.run_script()
        return next(o for o in bpy.context.scene.objects if o.get("centaur") == "splats")["built for"]

    kinds = ("objects", "meshes", "materials", "images", "worlds", "node_groups", "cameras", "collections")
    counts = lambda: [len(getattr(bpy.data, kind)) for kind in kinds]
    state, before = run_text(), counts()
    text.from_string(text.as_string().replace('"near":', '"near":0.01,"far":', 1))
    is_replaced = run_text() != state and counts() == before
    stored = bpy.data.texts["centaur.py"].as_string().partition("\n")[2] == text.as_string()
    roots = sum("centaur" in o for o in bpy.data.objects if o.type == "EMPTY")
    bpy.context.window.scene = bpy.data.scenes.new("another")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend, use_scripts=True)
    listening = [f.__name__ for f in bpy.app.handlers.render_init]
    spared = not bpy.context.scene.objects and not bpy.context.scene.collection.children
    for handlers in (bpy.app.handlers.frame_change_post, bpy.app.handlers.render_init):
        handlers.clear()  # Python does not end while they are registered
    return {"is replaced": is_replaced, "is stored": stored, "roots": roots, "listening": listening.count("on_render"), "is spared": spared}


# --- the checks ---

def check_script(centaur, glb, folder):
    """Builds in every construction, in one process each; unsupported requests give one line."""
    script = folder / "scene.blend.py"
    run([*centaur, "convert", glb, script])
    python = [sys.executable, script]
    for construction in ("ewa", "cap", "shell"):
        run([*python, "--construction", construction, "--render", folder / f"{construction}.exr"])
    run([*python, "--render", folder / "layers.exr", "--layers", "--what", "all"])
    close = inside("compare", folder / "ewa.exr", folder / "cap.exr")["psnr"]
    assert close > 25, f"ewa and cap differ by more than models do: {close:.1f} dB"
    moved = (folder / "elsewhere").resolve()
    moved.mkdir(exist_ok=True)
    (moved / script.name).write_text(script.read_text())
    damaged = (folder / "damaged").resolve()
    shutil.rmtree(damaged, ignore_errors=True)
    damaged.mkdir()
    for file in [script, *folder.glob("scene_*")]:
        shutil.copy(file, damaged)
    cut = max(damaged.glob("scene_mesh*.exr"))
    cut.write_bytes(cut.read_bytes()[:-1])
    taken = folder / "taken.blend"
    taken.mkdir(exist_ok=True)
    for arguments, code, message in [
        ([script, "--render", "/nowhere/at/a.exr"], 1, "/nowhere/at/a.exr: cannot write: /nowhere/at is no folder"),
        ([script, "--save", taken], 1, "a folder of this name exists"),
        ([script, "--save", folder / "scene"], 2, "--save: expected a name that ends in .blend"),
        ([script, "--render", folder / "layers.png", "--layers"], 2, "--layers: expected --render FILE.exr"),
        ([script, "--sh-direction", "ray"], 2, "--sh-direction ray: expected --construction cap or shell"),
        ([script, "--render", "a.tif"], 2, "expected a name that ends in .exr or .png"),
        ([script, "--render", folder / "scene_mesh0_sh00.exr"], 1, "this script reads a file of this name"),
        ([damaged / script.name], 1, f"{cut.name}: expected an OpenEXR picture, found a file that is cut or damaged"),
        ([script, "--camera", "99"], 1, "--camera: expected 0 to "),
        ([script, "--camera", "nobody"], 1, "found nobody"),
        ([script, "--camera", "path"], 1, "expected --path"),
        ([moved / script.name], 1, "it lies beside the script where"),
    ]:
        error = run([sys.executable, *arguments], expect=code).stderr
        assert message in error and "Traceback" not in error, f"{arguments}: {error}"
    print(f"script: ewa and cap are {close:.1f} dB apart")
    return script


def check_parts(centaur, glb, folder):
    """Scenes without meshes, without splats, without cameras."""
    run([*centaur, "convert", glb, folder / "splats.ply"])
    run([*centaur, "convert", folder / "splats.ply", folder / "bare.blend.py"])
    run([sys.executable, folder / "bare.blend.py", "--render", folder / "bare.png"])
    run([*centaur, "convert", glb, folder / "mesh.blend.py", "--min-opacity", "1"])
    run([sys.executable, folder / "mesh.blend.py", "--render", folder / "mesh.exr", "--layers", "--save", folder / "mesh.blend"])
    print("scenes without meshes and cameras, and without splats: render")


def check_flat(centaur, folder):
    """Splats without thickness, one across the view and one at an angle, differ between constructions as the image
    models do."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    shape = [1, 0, -1, 2, -1.5, -1.5, -200]  # colour, opacity logit, logarithms of scales
    rows = np.array([[-0.5, 0, 0, *shape, 1, 0, 0, 0], [0.5, 0, 0, *shape, 0.9, 0.3, 0.2, 0]], "<f4")
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2", *(f"property float {name}" for name in names), "end_header\n"]
    (folder / "flat.ply").write_bytes("\n".join(header).encode() + rows.tobytes())
    run([*centaur, "convert", folder / "flat.ply", folder / "flat.blend.py"])
    for construction in ("ewa", "cap", "shell"):
        run([sys.executable, folder / "flat.blend.py", "--construction", construction, "--render", folder / f"flat-{construction}.exr"])
    models, same = (inside("compare", folder / f"flat-{a}.exr", folder / "flat-cap.exr")["psnr"] for a in ("ewa", "shell"))
    assert models > 25 and same > 60, f"flat splats: cap is {models:.1f} dB from ewa and {same:.1f} dB from shell"
    # Nothing is clipped because it is far away.
    rows[:, :3], rows[:, 7:10] = 1e6 * rows[:, :3], rows[:, 7:10] + np.log(1e6)
    (folder / "far.ply").write_bytes("\n".join(header).encode() + rows.tobytes())
    run([*centaur, "convert", folder / "far.ply", folder / "far.blend.py"])
    run([sys.executable, folder / "far.blend.py", "--render", folder / "far.exr"])
    near, far = (inside("compare", folder / "far.exr", folder / f"{name}.exr")["seen"] for name in ("flat-ewa", "far"))
    assert far > 0.5 * near > 0, f"splats cover {near} pixels nearby and {far} far away"
    print(f"flat splats: cap is {models:.0f} dB from ewa and {same:.0f} dB from shell")


def check_size(centaur, glb, folder):
    """A scene in other units gives the same picture, after `check_script`."""
    large = folder / "large.blend.py"
    run([*centaur, "convert", glb, large, "--scale", "1000000"])
    run([sys.executable, large, "--render", folder / "large.exr"])
    same = inside("compare", folder / "ewa.exr", folder / "large.exr")["psnr"]
    assert same > 60, f"a scene a million times as large is another picture: {same:.1f} dB"
    print(f"a million times as large: {same:.0f} dB from the picture")


def check_own(script, folder):
    """In the user's own .blend the picture is the same, after `check_script`."""
    inside("own", script, folder / "own.blend", folder / "own.exr")
    same = inside("compare", folder / "ewa.exr", folder / "own.exr")["psnr"]
    assert same > 80, f"settings of the file change the picture: {same:.1f} dB"
    print(f"in a file with other settings: {same:.0f} dB from the picture")


def check_text(script, folder):
    """Checks the text editor, after `check_script`."""
    found = inside("text", script, folder / "text.blend")
    assert found == {"is replaced": True, "is stored": True, "roots": 1, "listening": 1, "is spared": True}, found
    print("in the text editor: replaces what it has built; what it stores builds nothing")


def check_names(script, folder):
    """The second of two cameras gives the same picture by its number and by its name."""
    head, told, rest = re.split(r"r\'\'\'(.*)\'\'\'", script.read_text(), maxsplit=1)
    scene = json.loads(told)
    scene["cameras"][1]["name"] = "path"  # the name used by `centaur cameras --with-scene`, not the camera of --path
    named = folder / "named.blend.py"
    named.write_text(f"{head}r'''{json.dumps(scene)}'''{rest}")
    for camera in ("0", "1", "path"):
        run([sys.executable, named, "--camera", camera, "--render", folder / f"camera_{camera}.exr"])
    same, other = (inside("compare", folder / "camera_path.exr", folder / f"camera_{n}.exr")["psnr"] for n in (1, 0))
    assert same > 80 > 40 > other, f"by name and by number {same:.1f} dB apart, of another camera {other:.1f} dB"


def check_blend(centaur, glb, folder):
    """A .blend keeps working without the script and the files beside it."""
    # Two cameras: the scene's own, and a rotated one.
    run([*centaur, "convert", glb, folder / "turned.glb", "--rotate", "10,40,0"])
    script = folder / "path.blend.py"
    run([*centaur, "convert", glb, folder / "turned.glb", script])
    run([sys.executable, script, "--save", folder / "scene.blend", "--path", "4", "--camera", "path",
         "--render", folder / "path.exr"])
    check_names(script, folder)
    alone = folder / "alone"
    alone.mkdir(exist_ok=True)
    # Only the camera path is animated: one frame, for one camera; in a folder that is created.
    stills = folder / "stills"
    shutil.rmtree(stills, ignore_errors=True)
    run([sys.executable, script, "--frame", "all", "--render", stills / "still.png"])
    assert [p.name for p in stills.iterdir()] == ["still_0001.png"]
    error = run([sys.executable, script, "--frame", "all", "--camera", "all", "--save", folder / "none.blend"], expect=1).stderr
    assert "--frame all: expected one camera" in error and not (folder / "none.blend").exists(), error
    blend = (folder / "scene.blend").rename(alone / "scene.blend")
    found = inside("reopen", blend, alone)
    assert found["states"] == 6 and found["unchanged"], found
    for name in ("radiance:base", "radiance:sh_0", "scale", "rotation"):
        assert name in found["attributes"], found
    same = [inside("compare", folder / f"path_{f:04}.exr", alone / f"frame_{f:04}.exr")["psnr"] for f in (2, 3)]
    assert all(psnr > 80 for psnr in same), f"frames of the .blend differ from the script's: {same} dB"
    print(f"saved .blend: builds its splats anew; frames as the script's, {min(same):.0f} dB")


def check_import(glb, script, folder):
    """The mesh of a .glb as displayed by Blender's own importer: in linear light, with 8 bits, without view
    dependence."""
    found = inside("import", glb, folder / "import.exr")
    assert sorted(faces > 0 for _, _, faces in found["meshes"]) == [False, True] and found["cameras"] >= 1, found
    assert all(vertices > 0 for _, vertices, _ in found["meshes"]), found
    run([sys.executable, script, "--what", "mesh", "--space", "linear", "--render", folder / "ours.exr"])
    close = inside("compare", folder / "import.exr", folder / "ours.exr")["psnr"]
    assert close > 25, f"the imported mesh looks different: {close:.1f} dB"
    print(f"import of the .glb: {found['meshes']}, mesh as ours in linear light, {close:.1f} dB")


def main():
    import bpy
    centaur, glb, folder = shlex.split(sys.argv[1]), pathlib.Path(sys.argv[2]).resolve(), pathlib.Path(sys.argv[3]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"Blender {bpy.app.version_string}")
    script = check_script(centaur, glb, folder)
    check_flat(centaur, folder)
    check_size(centaur, glb, folder)
    check_own(script, folder)
    check_text(script, folder)
    check_parts(centaur, glb, folder)
    check_blend(centaur, glb, folder)
    check_import(glb, script, folder)


if __name__ == "__main__":
    if sys.argv[1].startswith("--"):
        result = globals()[f"step_{sys.argv[1][2:]}"](*sys.argv[2:])
        print("\nRESULT " + json.dumps(result), flush=True)
    else:
        main()
