# ---------------------------------------------------------------------------------------------------------------------
# Cameras. Blender's look along -z with y up; a principal point off the centre is a shift, fx ≠ fy the aspect of pixels.

SENSOR = 36.0  # mm; any number would do


def optics(camera):
    """(lens in mm, shift x, shift y, pixel aspect x, pixel aspect y) of a camera of the scene."""
    stretch = camera["fx"] / camera["fy"]
    width, height = camera["width"], camera["height"]
    shift = ((0.5 * width - camera["cx"]) / width, (camera["cy"] - 0.5 * height) * stretch / width)
    return camera["fx"] / width * SENSOR, *shift, max(1 / stretch, 1), max(stretch, 1)


def pose(camera):
    """Camera to scene, in Blender's axes of cameras."""
    rotation = np.reshape(camera["rotation"], (3, 3))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * [1, -1, -1]
    matrix[:3, 3] = -rotation.T @ camera["translation"]
    return Matrix(matrix)



def add_camera(collection, root, camera):
    data = bpy.data.cameras.new(camera["name"])
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.lens, data.shift_x, data.shift_y = optics(camera)[:3]
    # Materials cut at `near`; triangles of `cap` may begin a little before their peaks. Cameras have room to move.
    near = SCENE["composition"]["near"]
    data.clip_start, data.clip_end = 0.9 * near, max(1e5, 5e5 * near, 10 * root["far"])
    thing = attach(collection, root, camera["name"], data)
    thing.matrix_basis = pose(camera)
    thing["centaur"] = "camera"
    thing["picture"] = [camera["width"], camera["height"], *optics(camera)[3:]]
    return thing


def scene_cameras(root):
    """In the order of the scene; Blender gives children in that of their names."""
    return sorted((c for c in root.children if c.get("centaur") == "camera"), key=lambda c: c["index"])


def look_through(thing):
    """Makes a camera active, and the picture as large as its own."""
    scene = bpy.context.scene
    scene.camera = thing
    width, height, aspect_x, aspect_y = thing["picture"]
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = int(width), int(height), 100
    render.pixel_aspect_x, render.pixel_aspect_y = aspect_x, aspect_y


def add_path(collection, root, frames):
    """One camera that is at camera i at frame 1 + i·frames."""
    scene, cameras = bpy.context.scene, SCENE["cameras"]
    thing = add_camera(collection, root, dict(cameras[0], name=f"{SCENE['name']} path"))
    thing["centaur"] = "path"
    thing.rotation_mode = "QUATERNION"
    last = None
    for index, camera in enumerate(cameras):
        frame = 1 + index * frames
        location, rotation, _ = pose(camera).decompose()
        if last is not None and rotation.dot(last) < 0:
            rotation.negate()
        last = rotation
        thing.location, thing.rotation_quaternion = location, rotation
        thing.data.lens, thing.data.shift_x, thing.data.shift_y = optics(camera)[:3]
        for owner, channel in ((thing, "location"), (thing, "rotation_quaternion"), (thing.data, "lens"),
                               (thing.data, "shift_x"), (thing.data, "shift_y")):
            owner.keyframe_insert(channel, frame=frame)
    scene.frame_start, scene.frame_end = 1, 1 + (len(cameras) - 1) * frames
    return thing


def current_view(scene, root, near, depsgraph=None):
    """What the active camera of Blender sees, as a camera of the scene."""
    thing = scene.camera.evaluated_get(depsgraph) if depsgraph else scene.camera
    data, render = thing.data, scene.render
    width = max(1, render.resolution_x * render.resolution_percentage // 100)
    height = max(1, render.resolution_y * render.resolution_percentage // 100)
    if data.type != "PERSP":
        raise ScriptError(f"camera `{thing.name}`: expected perspective, found {data.type}: splats are projected by a pinhole")
    tall = render.pixel_aspect_y / render.pixel_aspect_x
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= height * tall else "VERTICAL"
    reference = width if fit == "HORIZONTAL" else height * tall
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    fx = data.lens / sensor * reference
    cx, cy = 0.5 * width - data.shift_x * reference, 0.5 * height + data.shift_y * reference / tall
    top = root.evaluated_get(depsgraph) if depsgraph else root
    placed = np.array(top.matrix_world.inverted() @ thing.matrix_world)
    turn = placed[:3, :3] / np.linalg.norm(placed[:3, :3], axis=0)
    rotation = (turn * [1, -1, -1]).T
    return View(width, height, fx, fx / tall, cx, cy, rotation, -rotation @ placed[:3, 3], near)
