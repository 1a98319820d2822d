# ---------------------------------------------------------------------------------------------------------------------
# The command, and what goes on in a saved .blend.

HELP = """\
Builds the scene in Blender: a collection with meshes, splats and cameras, with settings of Cycles under which a picture is
what the optimiser saw. Runs in Blender's text editor (open it, press Run), with `blender --python FILE`, or with the module
`bpy` of PyPI. The files beside it are needed until a .blend is saved, which holds everything.

In a .blend of yours the scene that is open gets a collection more, and its engine, resolution, view transform, exposure, world,
compositor, sequencer, stereo and what its view layers override are set for it. Run again, the script replaces what it has
built, unless a file beside it is missing; a file takes one such scene.

constructions of splats:
  ewa    the raster model, which scenes are trained with: a quad per splat at its depth. Exact for the active camera.
  cap    the ray model: a curved patch per splat where rays peak. Alpha is exact for any camera that sees the patch; the
         order and, with --sh-direction mean, the colours are those of the active camera.
  shell  the ray model without a camera: an ellipsoid per splat, in the order in which rays enter them. Approximate
         (about 41 dB against cap); for moving around.

What the scene's animations move is moved: bones of an armature, shape keys, objects and cameras have keys at every frame, and
splats that are bound to triangles follow them as `ewa` and `cap` follow the camera.

When the camera moves, `ewa` and `cap` have to be built again. That happens at every change of the frame and before every
render, by the text `centaur.py` that is stored in a saved .blend and does nothing else; Blender runs it when it opens the
file if "Auto Run Python Scripts" is on in its preferences, else press Run in the text editor. In between, the viewport
shows the splats for the camera that they were built for.

spaces:
  blending  values are blended as the optimiser did, sRGB-encoded for most scenes; exact. The view transform is Raw, and
            lamps or other objects of the file have to be made for such values.
  linear    colours are decoded first and blended as light, as everything else in Blender: other pictures where something
            is translucent (19 to 24 dB), to be mixed with what Blender lights.

Several samples per pixel: raise Samples and set Pixel Filter to Blackman-Harris, 1.5 px.
"""
EXAMPLES = """\
examples:
  python3 NAME.blend.py --save scene.blend
  python3 NAME.blend.py --render out.exr --camera 3 --construction cap --layers
  python3 NAME.blend.py --render out.png --camera IMG_0042.jpg
  python3 NAME.blend.py --render frames/out.png --frame all
  python3 NAME.blend.py --path 24 --camera path --render frames/out.png
  blender --background --python NAME.blend.py -- --save scene.blend"""


def parse(arguments):
    parser = argparse.ArgumentParser(prog=own_name(), description=HELP, epilog=EXAMPLES.replace("NAME.blend.py", shlex.quote(own_name())),
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--save", metavar="FILE.blend", help="save the scene, maps packed into it")
    add("--render", metavar="FILE.exr|png", help="render; .exr holds 32-bit floats, premultiplied, without the background, in "
        "the space of --space; .png the picture on the background in sRGB; its folder is made if one alone is missing")
    add("--camera", default="0", metavar="NAME|N|all|path", help="the active camera: its name in the scene, or its number, from 0; "
        "`all` renders each, to FILE_000.exr and so on; `path` each frame of --path")
    add("--construction", choices=("cap", "ewa", "shell"), default="ewa", help="of splats, see above (default: ewa)")
    add("--space", choices=("blending", "linear"), default="blending", help="see above (default: blending)")
    add("--what", choices=("all", "splats", "mesh"), default="all", help="what is rendered")
    add("--layers", action="store_true", help="write also splats.RGBA and mesh.RGBA, premultiplied and as occluded by each "
        "other, and the mean depth Z; takes a second rendering")
    add("--sh-direction", choices=("mean", "ray"), default="mean", help="direction at which SH of splats are evaluated in cap "
        "and shell: from the camera to the mean, or of the pixel's ray (default: mean)")
    add("--triangles", type=int, default=2 * MILLION, metavar="N", help="most that patches of cap are made of; more order "
        "splats that are close to each other more exactly (default: 2000000)")
    add("--frame", default="1", metavar="N|all", help="frame of an animation that is rendered, from 1, which is its first key; `all` "
        "renders each, to FILE_0001.exr and so on, where nothing moves one (default: 1)")
    add("--path", type=int, metavar="FRAMES", help="add a camera that moves through all others, FRAMES from one to the next")
    options = parser.parse_args(arguments)
    if options.triangles < 1:
        parser.error(f"--triangles: expected at least 1, found {options.triangles}")
    if options.path is not None and options.path < 1:
        parser.error("--path: expected at least 1 frame")
    if options.frame != "all" and not (is_number(options.frame) and 1 <= int(options.frame) <= LAST_FRAME):
        parser.error(f"--frame: expected a number from 1 to {LAST_FRAME}, or `all`, found {printable(options.frame)}")
    if options.render and not options.render.lower().endswith((".exr", ".png")):
        parser.error(f"--render: expected a name that ends in .exr or .png, found {options.render}")
    if options.save and not options.save.lower().endswith(".blend"):
        parser.error(f"--save: expected a name that ends in .blend, found {options.save}")
    if options.layers and not (options.render or "").lower().endswith(".exr"):
        parser.error("--layers: expected --render FILE.exr, which can hold them")
    if options.sh_direction == "ray" and options.construction == "ewa":
        parser.error("--sh-direction ray: expected --construction cap or shell; splats of ewa have one colour each")
    return options


def own_name():
    """Name of the file or text that runs."""
    return os.path.basename(globals().get("__file__", "")) or f"{SCENE['name']}.blend.py"


def say(text):
    print(f"{own_name()}: {text}", file=sys.stderr)


def own_text():
    """The text that is run in the text editor, where `__file__` is that of the .blend and the text's name; None where a file is run."""
    path = globals().get("__file__", "")
    return None if os.path.isfile(path) else bpy.data.texts.get(os.path.basename(path))


def home():
    """The folder of this script and of the files beside it."""
    texts = [own_text(), *bpy.data.texts]  # run in the text editor
    paths = [globals().get("__file__", ""), *(bpy.path.abspath(text.filepath) for text in texts if text is not None and text.filepath)]
    folders = [os.path.dirname(os.path.abspath(path)) for path in paths if os.path.isfile(path)] or [os.getcwd()]
    named = [SCENE["splats"]] if SCENE["splats"] else [m["surface"] for m in SCENE["meshes"]]
    return next((f for f in folders if all(os.path.isfile(os.path.join(f, name)) for name in named)), folders[0])


def source():
    """The text of this script; None where it is neither a file nor a text, as in Python's console."""
    text, path = own_text(), globals().get("__file__", "")
    if text is not None:
        return text.as_string()
    if not os.path.isfile(path):
        return None
    with open(path, encoding="utf-8") as file:
        return file.read()


def on_frame(scene, depsgraph=None):
    """Builds the splats again if the camera has moved."""
    try:
        refresh(depsgraph=depsgraph)
    except ScriptError as error:
        say(error)


def on_render(scene, depsgraph=None):
    on_frame(scene)


def listen(is_on=True):
    """Registers the above, in the place of what an earlier run registered."""
    for handlers, function in ((bpy.app.handlers.frame_change_post, on_frame), (bpy.app.handlers.render_init, on_render)):
        for known in [h for h in handlers if h.__name__ == function.__name__]:
            handlers.remove(known)
        if is_on:
            handlers.append(bpy.app.handlers.persistent(function))


STORED = "CENTAUR_STORED = True  # builds nothing\n"  # what the stored text begins with


def keep_script():
    """Stores this script in the file, to be run when it is opened."""
    script = source()
    if script is None:
        say("the file will not build its splats again when it is opened: this script is neither a file nor a text")
        return
    text = bpy.data.texts.get("centaur.py") or bpy.data.texts.new("centaur.py")
    text.from_string(STORED + script)
    text.use_module = True


def writable(path, makes_folder=False):
    folder = os.path.dirname(os.path.abspath(path))
    if makes_folder and not os.path.lexists(folder) and os.path.isdir(os.path.dirname(folder)):
        folder = os.path.dirname(folder)
    if not os.path.isdir(folder):
        raise ScriptError(f"{path}: cannot write: {folder} is no folder")
    if os.path.isdir(path):
        raise ScriptError(f"{path}: cannot write: a folder of this name exists")
    if not os.access(folder, os.W_OK):
        raise ScriptError(f"{path}: cannot write: {folder} is not writable")


def spare_own(path):
    """Refuses to write over what the script reads."""
    names = [SCENE["splats"], *(name for mesh in SCENE["meshes"] for name in (mesh["surface"], *mesh["maps"]))]
    own = [os.path.join(home(), name) for name in names if name] if os.path.exists(path) else []
    if any(os.path.exists(name) and os.path.samefile(name, path) for name in own):
        raise ScriptError(f"{path}: cannot write: this script reads a file of this name")


def make_folder(path):
    """The folder of a picture, where `writable` has let it be missing."""
    folder = os.path.dirname(os.path.abspath(path))
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise ScriptError(f"{path}: cannot write: cannot make {folder} ({error.strerror})")


def overview(root):
    """A camera for a scene without any: in front of what there is."""
    corners = np.concatenate([np.array(c.bound_box) for c in root.children if c.type == "MESH" and c.data.vertices])
    middle, size = (corners.min(0) + corners.max(0)) / 2, max(np.linalg.norm(np.ptp(corners, axis=0)), 1e-3)
    distance = size + SCENE["composition"]["near"]
    return add_camera(root.users_collection[0], root, {
        "name": "overview", "width": 1280, "height": 720, "fx": 1000.0, "fy": 1000.0, "cx": 640.0, "cy": 360.0,
        "rotation": np.eye(3).tolist(), "translation": (-middle + [0, 0, distance]).tolist()})


def check(options):
    """Refuses what cannot be done, before anything is."""
    if options.save:
        writable(options.save)
    if options.render:
        writable(options.render, makes_folder=True)
        spare_own(options.render)
    count = len(SCENE["cameras"])
    if options.path and options.path * (count - 1) >= LAST_FRAME:
        raise ScriptError(f"--path: expected at most {LAST_FRAME} frames through {count} cameras, found {options.path} from one to the next")
    if is_path(options):
        if not options.path or count < 2:
            raise ScriptError("--camera path: expected --path and two cameras or more")
    elif options.camera == "all":
        if options.frame == "all" and count > 1:
            raise ScriptError("--frame all: expected one camera, by --camera N, NAME or path")
    elif count and camera_index(options.camera) is None:
        names = [printable(camera["name"]) for camera in SCENE["cameras"][:SOME]]
        some = ", ".join(names) + (", …" if count > SOME else "")
        raise ScriptError(f"--camera: expected 0 to {count - 1}, a name ({some}), `all` or `path`, found {printable(options.camera)}")


SOME = 5  # names of cameras that a message lists
LAST_FRAME = 1048574  # that Blender has


def is_number(text):
    """Whether it is one of a camera or a frame, of digits alone."""
    return text.isascii() and text.isdigit() and len(text) < 10


def printable(text):
    """Text in one line, whatever is in it."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def is_path(options):
    """Whether the camera of --path is meant: a scene may have one of that name, as `centaur cameras --with-scene` calls its own."""
    return options.camera == "path" and (options.path is not None or camera_index("path") is None)


def camera_index(text):
    """Index of the camera of this name, of several the first, or else of this number, as in hybrid_rf.py. None if there is none."""
    names = [camera["name"] for camera in SCENE["cameras"]]
    if text in names:
        return names.index(text)
    return int(text) if is_number(text) and int(text) < len(names) else None


def chosen(options, root):
    """The cameras to render; the first is made active."""
    if is_path(options):
        return [next(c for c in root.children if c.get("centaur") == "path")]
    cameras = scene_cameras(root)
    if not cameras:
        return [overview(root)]
    return cameras if options.camera == "all" else [cameras[camera_index(options.camera)]]


def show(options, root):
    """Hides what --what leaves out: meshes from rays alone, since splats follow them, and Blender moves only what is not disabled."""
    for thing in root.children:
        kind = thing.get("centaur")
        if kind == "mesh" and options.what == "splats":
            for rays in ("camera", "diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
                setattr(thing, f"visible_{rays}", False)
            thing.display_type = "BOUNDS"  # in the viewport, where there are no rays
        elif kind == "splats" and options.what == "mesh":
            thing.hide_render = thing.hide_viewport = True


def run(options):
    check(options)
    if bpy.app.background and not bpy.data.filepath:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    spare_other()
    files = read_files(home())
    names = [image.name for _, maps in files[1] for image in maps]
    try:
        remove_former()
        build(files, options)
    except BaseException:
        remove_former()
        left = [bpy.data.images.get(name) for name in names]
        bpy.data.batch_remove([image for image in left if image and not image.users])
        raise
    root, settings = find_root()
    settle(settings["decode"])
    cameras = chosen(options, root)
    look_through(cameras[0])
    scene = bpy.context.scene
    scene.frame_set(1 if options.frame == "all" else int(options.frame))
    refresh()
    show(options, root)
    listen()
    keep_script()
    if options.save:
        # No .blend1 beside it; the preference is the user's.
        paths = bpy.context.preferences.filepaths
        versions, paths.save_version = paths.save_version, 0
        try:
            with quiet():
                bpy.ops.file.pack_all()
                bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(options.save), check_existing=False)
        except RuntimeError as error:
            raise ScriptError(f"{options.save}: cannot write ({str(error).strip()})")
        finally:
            paths.save_version = versions
    if not options.render:
        return
    stem, extension = os.path.splitext(options.render)

    def save(path):
        picture = render_picture(options.layers)
        make_folder(path)
        write_picture(path, picture, settings["decode"])

    if is_path(options) or options.frame == "all":
        moves = SCENE["motion"] or is_path(options)
        for frame in range(scene.frame_start, scene.frame_end + 1) if moves else [1]:
            scene.frame_set(frame)
            refresh()
            save(f"{stem}_{frame:04}{extension}")
        return
    for index, camera in enumerate(cameras):
        look_through(camera)
        bpy.context.view_layer.update()
        refresh()
        save(f"{stem}_{index:03}{extension}" if options.camera == "all" else options.render)


def main():
    if bpy is not None and "CENTAUR_STORED" in globals():
        on_frame(bpy.context.scene)  # the text in a .blend: on opening it, whatever scene is active, or by Run
        listen()
        return
    if bpy is not None and bpy.app.binary_path:
        arguments = sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    else:
        arguments = sys.argv[1:]
    options = parse(arguments)
    if bpy is None or bpy.app.version < (4, 5, 0):
        sys.exit(f"{own_name()}: this script needs Blender 4.5 or later: pip install bpy==4.5.15 (Python 3.11), or "
                 "blender --background --python FILE -- OPTIONS")
    try:
        run(options)
    except ScriptError as error:
        if not bpy.app.background:
            raise RuntimeError(str(error)) from None  # leaving would end Blender
        sys.exit(f"{own_name()}: {error}")
    finally:
        if not bpy.app.binary_path:
            listen(False)  # the module `bpy` does not end while Python functions are registered


if __name__ == "__main__":
    main()
