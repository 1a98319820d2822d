# ---------------------------------------------------------------------------------------------------------------------
# What moves. Keys stand at every frame, so that what is between keys of the file is as it has it: objects and bones
# with location, rotation and scale, shape keys with values. Frame 1 is the first key of the animation. Splats follow in
# `followed`.

LINEAR = 1  # of the interpolations of a key
FLAT = 1e-12  # the shortest axis to the longest, as `scene/placement.rs` has it


def frame_count():
    return SCENE["motion"]["frames"] if SCENE["motion"] else 1


def read_motion(folder):
    """The arrays that `centaur convert` wrote; None where nothing moves."""
    if not SCENE["motion"]:
        return None
    path = os.path.join(folder, SCENE["motion"]["file"])
    try:
        with np.load(path) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError) as error:
        raise ScriptError(f"{path}: cannot read ({error}); it lies beside the script where `centaur convert` wrote it")


def set_clock(has_path):
    """The frames of the animation, and how many there are a second."""
    scene, fps = bpy.context.scene, SCENE["motion"]["fps"]
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    scene.frame_start, scene.frame_end = 1, max(scene.frame_end if has_path else 1, frame_count())


def animate(owner, channels):
    """Keys {data path: values [frames, width]} of an ID that has the first of these values; what never changes has none."""
    channels = {path: values for path, values in channels.items() if np.ptp(values, axis=0).any()}
    if not channels:
        return
    action = bpy.data.actions.new(owner.name)
    slot = action.slots.new(id_type=owner.id_type, name=owner.name)
    bag = action.layers.new("Layer").strips.new(type="KEYFRAME").channelbag(slot, ensure=True)
    for path, values in channels.items():
        values = np.asarray(values, np.float64).reshape(frame_count(), -1)
        for index in range(values.shape[1]):
            column = values[:, index] if np.ptp(values[:, index]) else values[:1, index]
            curve = bag.fcurves.new(path, index=index)
            curve.keyframe_points.add(len(column))
            curve.keyframe_points.foreach_set("co", np.stack([1 + np.arange(len(column)), column], 1).astype(np.float32).ravel())
            curve.keyframe_points.foreach_set("interpolation", np.full(len(column), LINEAR, np.int32))
            curve.update()
    data = owner.animation_data or owner.animation_data_create()
    data.action, data.action_slot = action, slot


def decomposed(matrices):
    """(location [F, 3], quaternion [F, 4] on one side, scale [F, 3], largest error relative to the scale) of [F, 4, 4]."""
    location, linear = matrices[:, :3, 3], matrices[:, :3, :3]
    scale = np.linalg.norm(linear, axis=1)
    scale[np.linalg.det(linear) < 0] *= -1
    unit = linear / np.where(scale == 0, 1, scale)[:, None]
    rotation = quaternions(unit)
    for i in range(1, len(rotation)):
        if rotation[i] @ rotation[i - 1] < 0:
            rotation[i] *= -1
    back = matrices_of(rotation) * scale[:, None]
    error = np.abs(back - linear).max((1, 2)) / np.maximum(np.abs(linear).max((1, 2)), 1e-30)
    return location, rotation, scale, float(error.max())


def matrices_of(q):
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z)."""
    return Splats(np.zeros((len(q), 3)), q, q, q, q).axes()


def quaternions(matrices):
    """Unit quaternions (w, x, y, z) [N, 4] of rotations [N, 3, 3], or of the rotations next to them."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, 0, -1)
    table = np.array([[a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g],
                      [c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e]])
    return np.linalg.eigh(np.moveaxis(table, -1, 0))[1][:, :, -1]


def move(thing, matrices):
    """Keys of an object that is at matrices [F, 4, 4] in the scene."""
    location, rotation, scale, error = decomposed(matrices)
    thing.rotation_mode = "QUATERNION"
    thing.location, thing.rotation_quaternion, thing.scale = location[0], rotation[0], scale[0]
    animate(thing, {"location": location, "rotation_quaternion": rotation, "scale": scale})
    if error > 1e-5:
        say(f"`{thing.name}` is sheared by up to {error:.1e}, which Blender's objects are not: it is shown unsheared")


def to_bone(motion, bone):
    """From where a thing on a bone is held to the space of the bone, [4, 4]."""
    return np.linalg.inv(motion["bones_rest"][bone])  # never of a flat bone: what is on one is held in its space


def add_motion(collection, root, motion, has_path):
    """Moves what has been built."""
    set_clock(has_path)
    meshes = mesh_objects(root)
    surfaces = SCENE["motion"]["meshes"]
    skinned = [i for i in surfaces if f"mesh{i}_joints" in motion]
    rig = add_armature(collection, root, motion, skinned) if skinned else None
    for index in surfaces:
        deform(meshes[index], motion, index, rig)
    if SCENE["motion"]["splats"]:
        bind(collection, root, motion)
    if SCENE["motion"]["cameras"]:
        for thing, rows in zip(scene_cameras(root), motion["cameras"].transpose(1, 0, 2)):
            move(thing, np.array([pose({"rotation": row[:9], "translation": row[9:]}) for row in rows]))


def skin_bones(motion, index):
    """The bones that move the skin of a mesh."""
    return np.unique(motion[f"mesh{index}_joints"][motion[f"mesh{index}_influences"] > 0]).tolist()


def rest_frames(motion, skinned):
    """Where skins rest in the scene: of every bone a similarity [B, 4, 4] from the frame in which it is bound, which may be any, z up or
    in other units. It is that of the topmost joint at rest, and one for all bones that move a mesh."""
    above, top = SCENE["motion"]["parents"], []
    for bone in range(len(above)):
        while above[bone] is not None:
            bone = above[bone]
        top.append(bone)
    for index in skinned:
        joined = {top[bone] for bone in skin_bones(motion, index)}
        top = [min(joined) if bone in joined else bone for bone in top]
    frames = motion["bones_rest"][top].copy()
    left, sizes, right = np.linalg.svd(frames[:, :3, :3])
    frames[:, :3, :3] = np.prod(sizes, axis=1)[:, None, None] ** (1 / 3) * (left @ right)
    return frames


def farthest_moved(motion):
    """How far from the origin of the scene anything that moves is at most."""
    far = norm_bound(motion["cameras"][..., 9:]) if "cameras" in motion else 0.0
    if "bones" not in motion:
        return far
    at = motion["bones"]
    stretched, shifted = np.linalg.norm(at[:, :, :3, :3], axis=(2, 3)).max(0), np.linalg.norm(at[:, :, :3, 3], axis=2).max(0)
    held = []  # (bones, the radius of what they hold, in its frame)
    for index in SCENE["motion"]["meshes"]:
        get = lambda what: motion.get(f"mesh{index}_{what}")
        bones = get("bone") if get("bone") is not None else skin_bones(motion, index)
        weights = np.abs(motion["weights"][:, get("weights")]).max(0)
        held.append((bones, norm_bound(get("base")) + sum(w * norm_bound(d) for w, d in zip(weights, get("deltas")))))
    if SCENE["motion"]["splats"]:
        sizes = np.linalg.norm(motion["splat_translations"], axis=1) + 4 * motion["splat_scales"].max(1)
        held += [([bone], sizes[motion["splat_bones"] == bone].max()) for bone in {*motion["splat_bones"]} - {-1, -2}]
    return max([far, *(float((stretched[bones] * size + shifted[bones]).max()) for bones, size in held)])


def mesh_objects(root):
    return {c["index"]: c for c in root.children if c.get("centaur") == "mesh"}


def deform(thing, motion, index, rig):
    """Gives a mesh its shape keys, and its bone or its armature, `rig` of `add_armature`."""
    get = lambda what: motion.get(f"mesh{index}_{what}")
    base, deltas, which, bone = get("base").astype(np.float64), get("deltas"), get("weights"), get("bone")
    if bone is None:
        rest = rig[2][skin_bones(motion, index)[0]]
        base, deltas = base @ rest[:3, :3].T + rest[:3, 3], deltas @ rest[:3, :3].T
    else:
        matrices = motion["bones"][:, bone[0]]
        if len(SCENE["meshes"][index]["maps"]) > 1:
            # View dependence is in the frame in which the mesh rests, which has to be that of the object.
            rest = motion["bones_rest"][bone[0]]
            base, deltas = base @ rest[:3, :3].T + rest[:3, 3], deltas @ rest[:3, :3].T
            matrices = motion["bones"][:, bone[0]] @ to_bone(motion, bone[0])
    thing.data.vertices.foreach_set("co", base.astype(np.float32).ravel())
    thing.data.update()
    set_planes(thing.data, base)
    if len(which):
        thing.shape_key_add(name="Basis")
        channels = {}
        for i, (delta, weight) in enumerate(zip(deltas, which)):
            values = motion["weights"][:, weight].astype(np.float64)
            unit = max(1.0, np.abs(values).max() / 10)  # Blender's values end at 10
            key = thing.shape_key_add(name=f"target {i}", from_mix=False)
            key.slider_min, key.slider_max = -10, 10
            key.value = values[0] / unit
            key.data.foreach_set("co", (base + unit * delta).astype(np.float32).ravel())
            channels[f'key_blocks["{key.name}"].value'] = values / unit
        animate(thing.data.shape_keys, channels)
    if bone is not None:
        move(thing, matrices)
        return
    armature, names, _ = rig
    groups = {bone: thing.vertex_groups.new(name=name) for bone, name in names.items()}
    joints, influences = get("joints"), get("influences").astype(np.float64)
    influences /= influences.sum(1, keepdims=True)
    for bone in np.unique(joints[influences > 0]):
        weights = np.where(joints == bone, influences, 0).sum(1)
        for weight in np.unique(weights[weights > 0]):
            groups[int(bone)].add(np.flatnonzero(weights == weight).tolist(), float(weight), "REPLACE")
    thing.modifiers.new("Armature", "ARMATURE").object = armature


def add_armature(collection, root, motion, skinned):
    """Bones of all skins where they were bound, each below the next joint above it, if Blender's bones can then be where they are.

    -> (armature, {bone: name}, `rest_frames`)
    """
    above, frames = SCENE["motion"]["parents"], rest_frames(motion, skinned)
    binds, at = frames @ motion["binds"], motion["bones"] @ np.linalg.inv(frames)
    used = {bone for index in skinned for bone in skin_bones(motion, index)}
    for bone in list(used):  # joints between others
        while (bone := above[bone]) is not None:
            used.add(bone)
    used = sorted(used)
    rests = {bone: np.eye(4) for bone in used}
    for bone in used:
        linear = binds[bone][:3, :3]
        rests[bone][:3, :3] = matrices_of(quaternions((linear / np.maximum(np.linalg.norm(linear, axis=0), 1e-30))[None]))[0]
        rests[bone][:3, 3] = binds[bone][:3, 3]

    def local(bone, parent):
        """What Blender calls the basis of a bone: with all that it inherits, bone · rest is where it is."""
        rest = rests[bone]
        below = np.linalg.inv(at[:, parent]) if parent is not None else np.eye(4)
        return np.linalg.inv(rest) @ below @ at[:, bone] @ rest

    parents = {bone: above[bone] for bone in used}
    solid = all(np.abs(np.linalg.det(at[:, bone])).min() > 1e-12 for bone in used)
    if not solid or max(decomposed(local(b, p))[3] for b, p in parents.items()) > 1e-5:
        parents = dict.fromkeys(used)
    data = bpy.data.armatures.new(f"{root.name} rig")
    thing = attach(collection, root, data.name, data)
    thing["centaur"] = "rig"
    spread = np.array([rest[:3, 3] for rest in rests.values()])
    length = 0.1 * max(float(np.linalg.norm(np.ptp(spread, axis=0))), 1e-2)
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")
    names = {}
    for bone in used:
        edit = data.edit_bones.new(SCENE["motion"]["names"][bone])
        edit.head, edit.tail = (0, 0, 0), (0, length, 0)
        edit.matrix = Matrix(rests[bone])
        names[bone] = edit.name
    for bone, parent in parents.items():
        if parent is not None:
            data.edit_bones[names[bone]].parent = data.edit_bones[names[parent]]
    bpy.ops.object.mode_set(mode="OBJECT")
    channels, worst = {}, 0.0
    for bone, parent in parents.items():
        rests[bone] = np.array(data.bones[names[bone]].matrix_local, np.float64)  # as Blender has rounded it
        location, rotation, scale, error = decomposed(local(bone, parent))
        worst = max(worst, error)
        posed = thing.pose.bones[names[bone]]
        posed.location, posed.rotation_quaternion, posed.scale = location[0], rotation[0], scale[0]
        path = f'pose.bones["{bpy.utils.escape_identifier(names[bone])}"].'
        channels |= {path + "location": location, path + "rotation_quaternion": rotation, path + "scale": scale}
    animate(thing, channels)
    if worst > 1e-5:
        say(f"joints are sheared by up to {worst:.1e}, which Blender's bones are not: they are shown unsheared")
    return thing, names, frames


def bind(collection, root, motion):
    """Keeps with the splats what they follow: attributes of their points, and an empty for every bone."""
    data = next(c for c in root.children if c.get("centaur") == "splat data").data
    for name in ("bones", "surfaces", "harmonics"):
        data.attributes.new(f"follow:{name}", "INT", "POINT").data.foreach_set("value", motion[f"splat_{name}"])
    for i, corner in enumerate(motion["splat_corners"].T):
        data.attributes.new(f"follow:corner_{i}", "INT", "POINT").data.foreach_set("value", np.ascontiguousarray(corner))
    for name in ("translations", "rotations", "scales", "undeformed"):
        set_attribute(data, f"follow:{name}", motion[f"splat_{name}"])
    for bone in sorted({*motion["splat_bones"], *motion["splat_harmonics"]} - {-1, -2}):
        thing = attach(collection, root, f"{root.name} {SCENE['motion']['names'][bone]}", None)
        thing["centaur bone"] = int(bone)
        thing["to bone"] = to_bone(motion, bone).ravel().tolist()
        thing.empty_display_size = 0.1
        move(thing, motion["bones"][:, bone])


def in_scene(thing, root, depsgraph):
    """From an object's own frame to the scene's."""
    return np.array(root.evaluated_get(depsgraph).matrix_world.inverted() @ thing.evaluated_get(depsgraph).matrix_world)


def evaluated_points(thing, depsgraph):
    """Vertices [V, 3] of a mesh after shape keys and bones, in its own frame."""
    evaluated = thing.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    evaluated.to_mesh_clear()
    return points.reshape(-1, 3).astype(np.float64)


def followed(splats, root, data, depsgraph):
    """The splats of a carrier where what they follow is now."""
    if "follow:bones" not in data.attributes:
        return splats
    depsgraph = depsgraph or bpy.context.evaluated_depsgraph_get()
    integers = lambda name: get_attribute(data, f"follow:{name}", 1)[:, 0]
    bones, surfaces, harmonics = integers("bones"), integers("surfaces"), integers("harmonics")
    mean, scale, opacity, axes = splats.mean.copy(), splats.scale.copy(), splats.opacity.copy(), splats.axes()
    turn = np.tile(np.eye(3), (len(splats), 1, 1))
    for thing in root.children:
        if "centaur bone" not in thing:
            continue
        matrix = in_scene(thing, root, depsgraph) @ np.reshape(thing["to bone"], (4, 4))
        these, linear = bones == thing["centaur bone"], matrix[:3, :3]
        mean[these] = mean[these] @ linear.T + matrix[:3, 3]
        axes[these], scale[these] = ellipsoids(linear @ (axes[these] * scale[these][:, None]))
        left, sizes, right = np.linalg.svd(linear)
        is_flat = sizes[2] <= FLAT * sizes[0]
        opacity[these] *= not is_flat
        turn[harmonics == thing["centaur bone"]] = np.eye(3) if is_flat else left @ right
    meshes = mesh_objects(root)
    for surface in np.unique(surfaces[surfaces >= 0]):
        these, thing = np.flatnonzero(surfaces == surface), meshes[surface]
        matrix = in_scene(thing, root, depsgraph)
        points = evaluated_points(thing, depsgraph) @ matrix[:3, :3].T + matrix[:3, 3]
        v0, v1, v2 = (points[integers(f"corner_{i}")[these]] for i in range(3))
        frame, size, flat = frames_of(v0, v1, v2)
        get = lambda name, width: get_attribute(data, f"follow:{name}", width)[these].astype(np.float64)
        mean[these] = size[:, None] * np.einsum("nij,nj->ni", frame, get("translations", 3)) + (v0 + v1 + v2) / 3
        axes[these] = frame @ matrices_of(get("rotations", 4))
        scale[these] = np.maximum(size[:, None] * get("scales", 3), np.finfo(np.float32).tiny)
        opacity[these[flat]] = 0
        own = harmonics[these] < 0
        turn[these[own]] = (frame @ matrices_of(get("undeformed", 4)))[own]
    moved = bones != -1
    rotation, sh = splats.rotation.copy(), splats.sh.copy()
    rotation[moved], sh[moved] = quaternions(axes[moved]), turned(sh[moved], turn[moved])
    return Splats(mean, rotation, scale, opacity, sh)


def ellipsoids(conjugate):
    """Axes [N, 3, 3] in columns, a rotation, and lengths [N, 3] of half axes, of which the columns of [N, 3, 3] are conjugate ones."""
    axes, lengths, _ = np.linalg.svd(conjugate)
    return axes * np.sign(np.linalg.det(axes))[:, None, None], np.maximum(lengths, np.finfo(np.float32).tiny)


def frames_of(v0, v1, v2):
    """Of triangles: axes [N, 3, 3] in columns, sizes, and which have no area."""
    edge, other = v1 - v0, v2 - v0
    length = lambda v: np.linalg.norm(v, axis=1)
    normal = np.cross(edge, other)
    flat = (length(edge) == 0) | (length(normal) == 0)
    a0 = edge / np.maximum(length(edge), 1e-300)[:, None]
    a1 = normal / np.maximum(length(normal), 1e-300)[:, None]
    a2 = np.cross(a0, a1)
    return np.stack([a0, a1, a2], -1), 0.5 * (length(edge) + np.abs((a2 * other).sum(1))), flat


def turned(sh, turn):
    """Coefficients [N, K, 3] of the functions turned by rotations [N, 3, 3]: from their values in enough directions."""
    k = np.arange(32) + 0.5
    polar, azimuth = np.arccos(1 - k / 16), np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], 1)
    count = sh.shape[1]
    inverse, result = np.linalg.pinv(sh_basis(directions)[:, :count]), np.empty_like(sh)
    for start in range(0, len(sh), 10_000):
        part = np.s_[start:start + 10_000]
        result[part] = inverse @ (sh_basis(directions @ turn[part])[..., :count] @ sh[part])
    return result


def update_planes(root, depsgraph):
    """What the texture filter knows of triangles, where these are deformed."""
    for thing in mesh_objects(root).values():
        if not (thing.modifiers or thing.data.shape_keys):
            continue
        points = evaluated_points(thing, depsgraph or bpy.context.evaluated_depsgraph_get())
        state = str(zlib.crc32(points.tobytes()))
        if thing.get("planes of") == state:
            continue
        set_planes(thing.data, points)
        thing["planes of"] = state
