# ---------------------------------------------------------------------------------------------------------------------
# The scene in Blender. Everything hangs below one empty, which turns the frame of the scene (y down, as captures have
# it) to Blender's (z up); objects below it are not moved, so that their own frame is the scene's.

TURN = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))
MILLION = 1_000_000
# Measured with Blender 4.5.15 on 2 cores at 100 000 splats of degree 3: seconds to build a splat, bytes of it in a
# .blend.
COSTS = {"ewa": (3.5e-5, 465), "cap": (9e-5, 2300), "shell": (6e-5, 2000)}


def read_files(folder):
    """What lies beside the script: splats, the table and the maps of each mesh, and motion."""
    at = lambda name: os.path.join(folder, name)
    splats = read_splats(at(SCENE["splats"])) if SCENE["splats"] else None
    images = []
    try:
        surfaces = []
        for files in SCENE["meshes"]:
            maps = [load_map(at(name), images) for name in files["maps"]]
            surfaces.append((read_ply(at(files["surface"])), maps))
        return splats, surfaces, read_motion(folder)
    except BaseException:
        bpy.data.batch_remove(images)
        raise


def load_map(path, images):
    """The image at a path, which is also added to `images`."""
    if not os.access(path, os.R_OK):
        raise ScriptError(f"{path}: cannot read; it lies beside the script where `centaur convert` wrote it")
    damaged = ScriptError(f"{path}: expected an OpenEXR picture, found a file that is cut or damaged")
    if not is_whole_exr(path):
        raise damaged
    try:
        images.append(bpy.data.images.load(path))
    except RuntimeError:
        raise damaged
    if 0 in images[-1].size:  # what Blender has of a picture that it cannot read
        raise damaged
    return images[-1]


def build(files, options):
    """Makes the collection of what `read_files` has read; returns it."""
    splats, surfaces, motion = files
    name = SCENE["name"]
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new(name, None)
    root.matrix_world = Matrix(TURN)
    root.empty_display_type = "ARROWS"
    collection.objects.link(root)
    root["far"] = farthest(splats, [tables["vertex"] for tables, _ in surfaces], motion)
    # What the handler needs to go on in a saved .blend.
    decode = SCENE["composition"]["colorSpace"] == "srgb" and options.space == "linear"
    root["centaur"] = json.dumps({"scene": name, "construction": options.construction, "decode": decode, "near": SCENE["composition"]["near"],
                                  "low_pass": SCENE["composition"]["lowPass"],
                                  "sh_direction": options.sh_direction, "triangles": options.triangles})
    if splats is not None:
        warn_of_size(len(splats), options.construction)
        carrier(collection, root, splats)
    for index, (tables, maps) in enumerate(surfaces):
        add_mesh(collection, root, f"{name} mesh {index}", tables, maps, decode)["index"] = index
    for index, camera in enumerate(SCENE["cameras"]):
        add_camera(collection, root, camera)["index"] = index
    has_path = bool(options.path) and len(SCENE["cameras"]) > 1
    if has_path:
        add_path(collection, root, options.path)
    if motion is not None:
        add_motion(collection, root, motion, has_path)
    return collection


def farthest(splats, tables, motion):
    """How far from the origin of the scene anything is at most, at any time."""
    bounds = [norm_bound(np.reshape([camera["translation"] for camera in SCENE["cameras"]], (-1, 3)))]
    if splats is not None:
        bounds.append(norm_bound(splats.mean) + 4 * float(splats.scale.max()))
    bounds += [norm_bound(places(vertices)) for vertices in tables]
    if motion is not None:
        bounds.append(farthest_moved(motion))
    return max(bounds)


def norm_bound(vectors):
    """The length of the longest of vectors [..., 3]."""
    return float(np.linalg.norm(vectors, axis=-1).max(initial=0))


def warn_of_size(count, construction):
    seconds, size = COSTS[construction]
    if count > 2 * MILLION:
        say(f"{count} splats: building takes about {count * seconds:.0f} s, a .blend about {count * size / 1e9:.1f} GB; "
            "`centaur convert --decimate` makes fewer")


def attach(collection, root, name, content):
    thing = bpy.data.objects.new(name, content)
    thing.parent = root
    collection.objects.link(thing)
    return thing


def fill(mesh, points, faces):
    """Gives an empty mesh points [V, 3] and faces [F, 3 or 4]."""
    mesh.vertices.add(len(points))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(points, np.float32).ravel())
    if len(faces):
        mesh.loops.add(faces.size)
        mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
        mesh.polygons.add(len(faces))
        mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32))
    mesh.update(calc_edges=True)


def set_attribute(mesh, name, values, domain="POINT"):
    """An attribute by its width: float, vector, four floats or the quaternion."""
    values = np.ascontiguousarray(values, np.float32)
    width = values.shape[1]
    kind, field = {1: ("FLOAT", "value"), 3: ("FLOAT_VECTOR", "vector"), 4: ("FLOAT_COLOR", "color")}[width]
    if name == "rotation":
        kind, field = "QUATERNION", "value"
    mesh.attributes.new(name, kind, domain).data.foreach_set(field, values.ravel())


def get_attribute(mesh, name, width):
    attribute = mesh.attributes[name]
    values = np.empty(len(mesh.vertices) * width, np.int32 if attribute.data_type == "INT" else np.float32)
    attribute.data.foreach_get({"FLOAT_VECTOR": "vector", "FLOAT_COLOR": "color"}.get(attribute.data_type, "value"), values)
    return values.reshape(-1, width)


def carrier(collection, root, splats):
    """The parameters of all splats as points, with the attributes of the splats that Blender has from 5.3 on.

    It is not rendered; what is, is made from it.
    """
    mesh = bpy.data.meshes.new(f"{SCENE['name']} splat data")
    fill(mesh, splats.mean, np.zeros((0, 3)))
    set_attribute(mesh, "radiance:base", np.concatenate([splats.sh[:, 0], splats.opacity[:, None]], 1))
    set_attribute(mesh, "scale", splats.scale)
    set_attribute(mesh, "rotation", splats.rotation)
    for k in range(1, splats.sh.shape[1]):
        set_attribute(mesh, f"radiance:sh_{k - 1}", splats.sh[:, k])
    thing = attach(collection, root, mesh.name, mesh)
    thing.hide_render = thing.hide_viewport = True
    thing["centaur"] = "splat data"
    points = thing.modifiers.new("Points", "NODES")
    tree = bpy.data.node_groups.new("Centaur splat points", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    g = Graph(tree)
    to_points = g.node("GeometryNodeMeshToPoints")
    g.link(g.node("NodeGroupInput").outputs[0], to_points.inputs["Mesh"])
    geometry = to_points.outputs[0]
    if hasattr(bpy.types, "GeometryNodePointsSetType"):  # Blender 5.3
        native = g.node("GeometryNodePointsSetType")
        g.link(geometry, native.inputs[0])
        geometry = native.outputs[0]
    g.link(geometry, g.node("NodeGroupOutput").inputs[0])
    points.node_group = tree


def carried(mesh):
    """The splats of a carrier."""
    base = get_attribute(mesh, "radiance:base", 4)
    position = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", position)
    rest = [a.name for a in mesh.attributes if a.name.startswith("radiance:sh_")]
    sh = [base[:, :3]] + [get_attribute(mesh, f"radiance:sh_{k}", 3) for k in range(len(rest))]
    return Splats(position.reshape(-1, 3), get_attribute(mesh, "rotation", 4), get_attribute(mesh, "scale", 3), base[:, 3],
                  np.stack(sh, 1))


def places(vertices):
    """Positions [V, 3] of a table of vertices."""
    return np.stack([vertices[c] for c in "xyz"], 1).astype(np.float64)


def add_mesh(collection, root, name, tables, images, decode):
    vertices, corners = tables["vertex"], tables["face"]["vertex_indices"]
    mesh = bpy.data.meshes.new(name)
    points = places(vertices)
    fill(mesh, points, corners)
    # Blender's v points up.
    uv = np.stack([vertices["s"], 1 - vertices["t"].astype(np.float64)], 1)[corners]
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.astype(np.float32).ravel())
    for label in PLANES:
        mesh.attributes.new(label, "FLOAT_VECTOR", "FACE")
    set_planes(mesh, points)
    maps = []
    for image in images:
        image.name = os.path.basename(image.filepath)  # which that of a former scene had when it was loaded
        maps.append(mip_levels(image, "RGB" if maps else "RGBA"))
    mesh.materials.append(mesh_material(name, maps, decode, SCENE["composition"]["near"]))
    thing = attach(collection, root, name, mesh)
    thing.lightgroup = thing["centaur"] = "mesh"
    return thing


PLANES = ("face_normal", "gradient_u", "gradient_v")


def set_planes(mesh, points):
    """What the texture filter knows of triangles, from vertices [V, 3] in the frame of the object."""
    corners, uv = np.empty(len(mesh.loops), np.int32), np.empty(2 * len(mesh.loops), np.float32)
    mesh.loops.foreach_get("vertex_index", corners)
    mesh.uv_layers["UVMap"].data.foreach_get("uv", uv)
    for name, values in zip(PLANES, planes(points[corners.reshape(-1, 3)], uv.reshape(-1, 3, 2).astype(np.float64))):
        mesh.attributes[name].data.foreach_set("vector", values.astype(np.float32).ravel())
    mesh.update_tag()


def planes(corners, uv):
    """Of triangles [F, 3, 3] with coordinates [F, 3, 2]: normals, and gradients of u and of v along the surface [F, 3]."""
    edges, steps = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    # gradient = Σ c_i edge_i with gradient · edge_j = step_j
    (a, b), (_, d) = (edges @ edges.transpose(0, 2, 1)).transpose(1, 2, 0)
    area = a * d - b * b
    inverse = np.moveaxis(np.array([[d, -b], [-b, a]]), 2, 0) / np.where(area > 0, area, np.inf)[:, None, None]
    gradients = (inverse @ steps).transpose(0, 2, 1) @ edges
    return normals, gradients[:, 0], gradients[:, 1]


def mip_levels(image, channels):
    """The image and its means of 2×2 texels, as long as both sides are even, 5 at most."""
    prepare = lambda i: (setattr(i.colorspace_settings, "name", "Non-Color"), setattr(i, "alpha_mode", "CHANNEL_PACKED"))
    prepare(image)
    (width, height), levels = image.size, [image]
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    values = values.reshape(height, width, 4)[::-1].astype(np.float64)
    with tempfile.TemporaryDirectory() as folder:
        while len(levels) < 5 and values.shape[0] % 2 == 0 and values.shape[1] % 2 == 0:
            values = (values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]) / 4
            path = os.path.join(folder, f"{len(levels)}_{os.path.basename(image.filepath)}")
            write_exr(path, {c: values[..., i] for i, c in enumerate(channels)}, {})
            level = bpy.data.images.load(path)
            level.pack()
            prepare(level)
            levels.append(level)
    return levels


def find_root():
    """(root, what it says of itself) of the scene that this script built here, or (None, None)."""
    for thing in bpy.context.scene.objects:
        if thing.type == "EMPTY" and "centaur" in thing:
            return thing, json.loads(thing["centaur"])
    return None, None


def is_built():
    """Whether this script's own scene is here."""
    return find_root()[0] is not None and find_root()[1].get("scene") == SCENE["name"]


def spare_other():
    """Refuses to build beside another script's scene: handlers would not know which to follow."""
    root, settings = find_root()
    if root is not None and not is_built():
        raise ScriptError(f"this file holds `{settings.get('scene', root.name)}` already: expected a file without, or delete its collection")


def remove_former():
    """Takes away what this script has built here before."""
    root, _ = find_root()
    if root is None:
        return
    collections = list(root.users_collection)
    removed, count, users = {*root.children_recursive, root}, 0, bpy.data.user_map()
    # Meshes, materials, images, actions: what nothing else uses.
    while len(removed) > count:
        count = len(removed)
        removed |= {block for block, by in users.items() if by and by <= removed and not block.use_fake_user}
    bpy.data.batch_remove(removed)
    for collection in collections:
        if not collection.all_objects and not collection.children and collection != bpy.context.scene.collection:
            bpy.data.collections.remove(collection)


def refresh(force=False, depsgraph=None):
    """Builds the rendered splats for the active camera, unless that has been done."""
    scene = bpy.context.scene
    root, settings = find_root()
    if root is None or scene.camera is None:
        return
    view = current_view(scene, root, settings["near"], depsgraph)
    set_focal_lengths(view.fx, view.fy)
    update_planes(root, depsgraph)
    data = next((c for c in root.children if c.get("centaur") == "splat data"), None)
    if data is None:
        return
    splats = followed(carried(data.data), root, data.data, depsgraph)
    content = 0
    for values in (splats.mean, splats.rotation, splats.scale, splats.opacity, splats.sh):
        content = zlib.crc32(np.ascontiguousarray(values), content)
    state = json.dumps([settings, content,
                        [view.width, view.height, view.fx, view.fy, view.cx, view.cy],
                        view.rotation.tolist(), view.translation.tolist()])
    thing = next((c for c in root.children if c.get("centaur") == "splats"), None)
    if thing is not None and thing.get("built for") == state and not force:
        return
    construction = settings["construction"]
    decode, sh_direction = settings["decode"], settings["sh_direction"]
    if construction == "ewa":
        triangles = ewa(splats, view, decode, settings["low_pass"])
        layers = deepest(triangles, view)
        if layers > 1000:
            say(f"up to about {layers} splats lie behind one another; Cycles goes through 1024 surfaces and leaves out the rest")
    elif construction == "cap":
        triangles = cap(splats, view, decode, sh_direction, settings["triangles"])
    else:
        triangles = shell(splats, view, decode, sh_direction)
    if thing is None:
        mesh = bpy.data.meshes.new(f"{root.name} splats")
        coefficients = splats.sh.shape[1] if sh_direction == "ray" else 0
        is_shell = construction == "shell"
        mesh.materials.append(ewa_material(mesh.name) if construction == "ewa"
                              else ray_material(mesh.name, coefficients, decode, is_shell, settings["near"]))
        thing = attach(root.users_collection[0], root, mesh.name, mesh)
        thing["centaur"] = "splats"
        thing.lightgroup = "splats"
    mesh = thing.data
    mesh.clear_geometry()
    fill(mesh, triangles.points, triangles.faces)
    for name, values in triangles.attributes.items():
        set_attribute(mesh, name, values)
    thing["built for"] = state
