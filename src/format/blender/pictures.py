# ---------------------------------------------------------------------------------------------------------------------
# Rendering, and OpenEXR and PNG by hand: Blender can write arbitrary channels in no way that all its versions share.


def settle(decode):
    """Settings of Cycles under which a picture is exact: one sample at the centre of each pixel, and nothing random."""
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.film_transparent, render.use_motion_blur, render.use_border, render.use_multiview = True, False, False, False
    render.use_compositing = render.use_sequencer = False
    render.dither_intensity = 0
    render.use_persistent_data = False
    render.use_lock_interface = True  # splats are rebuilt while animations are rendered
    cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = 1, False, False
    cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", 0.01
    cycles.seed, cycles.film_exposure = 0, 1
    # Without the second, paths end at random behind many surfaces.
    cycles.transparent_max_bounces = cycles.min_transparent_bounces = 1024
    cycles.max_bounces = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    scene.display_settings.display_device = "sRGB"
    is_linear = decode or SCENE["composition"]["colorSpace"] == "linear"
    scene.view_settings.view_transform = "Standard" if is_linear else "Raw"
    scene.view_settings.look = "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0, 1
    if scene.world is None or "centaur" not in scene.world:
        scene.world = bpy.data.worlds.new(SCENE["name"])
    world = scene.world
    world["centaur"] = SCENE["name"]
    if not world.node_tree:
        world.use_nodes = True
    background = np.array(SCENE["composition"]["background"])
    shown = srgb_to_linear(background) if decode else background
    node = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    node.inputs["Color"].default_value = (*shown, 1)
    for layer in scene.view_layers:
        layer.material_override, layer.samples = None, 0
        for name in ("splats", "mesh"):
            if name not in layer.lightgroups:
                layer.lightgroups.add(name=name)


@contextlib.contextmanager
def quiet():
    """Without the lines that Cycles prints at every step."""
    if not bpy.app.background:
        yield
        return
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def render_channels(folder):
    """Renders; {channel: [h, w]} of all passes, `Combined.R` and so on."""
    scene = bpy.context.scene
    form = scene.render.image_settings
    saved = scene.render.filepath
    path = os.path.join(folder, "render.exr")
    if hasattr(form, "media_type"):  # Blender 5
        form.media_type = "MULTI_LAYER_IMAGE"
    form.file_format, form.color_depth, form.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    if hasattr(form, "use_exr_interleave"):
        form.use_exr_interleave = True  # Blender 5.0 fails to write several parts with pixels that are not square
    scene.render.filepath, scene.render.use_file_extension = path, False
    try:
        with quiet():
            bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        raise ScriptError(f"cannot render ({str(error).strip()})")
    scene.render.filepath = saved
    layer = bpy.context.view_layer.name + "."
    return {name.removeprefix(layer): plane for name, plane in read_exr(path).items()}


def render_picture(with_layers):
    """{channel: [h, w]}: premultiplied R G B A; with layers also theirs, and the mean depth Z (1e10 where there is nothing)."""
    with tempfile.TemporaryDirectory() as folder:
        shown = render_channels(folder)
        picture = {c: shown[f"Combined.{c}"] for c in "RGBA"}
        if not with_layers:
            return picture
        switch = bpy.data.node_groups[SURFACE].nodes[PROBE].outputs[0]
        switch.default_value = 1.0
        probed = render_channels(folder)
        switch.default_value = 0.0
    nothing = np.zeros_like(picture["A"])
    depth = nothing
    for layer in ("splats", "mesh"):
        of = lambda passes, c: passes.get(f"Combined_{layer}.{c}", nothing)
        picture.update({f"{layer}.{c}": of(shown, c) for c in "RGB"})
        picture[f"{layer}.A"] = of(probed, "R")
        depth = depth + of(probed, "G")
    picture["Z"] = np.divide(depth, picture["A"], out=np.full_like(depth, 1e10), where=picture["A"] > 0)
    return picture


def write_picture(path, picture, decode):
    is_linear = decode or SCENE["composition"]["colorSpace"] == "linear"
    if path.lower().endswith(".exr"):
        space = "lin_rec709_display" if is_linear else "srgb_rec709_display"
        return write_exr(path, picture, {"colorSpace": space, "comments": "Values as they were blended, not over the background."})
    background = np.array(SCENE["composition"]["background"])
    background = srgb_to_linear(background) if decode else background
    rgb = np.stack([picture[c] + (1 - picture["A"]) * b for c, b in zip("RGB", background)], -1).astype(np.float64)
    if is_linear:
        rgb = np.where(rgb <= 0.0031308, rgb * 12.92, 1.055 * np.maximum(rgb, 1e-9) ** (1 / 2.4) - 0.055)
    write_png(path, np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8))


def write_png(path, rgb):
    height, width = rgb.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], 1).tobytes()
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    write_file(path, b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b""))


def write_file(path, content):
    try:
        with open(path, "wb") as file:
            file.write(content)
    except OSError as error:
        raise ScriptError(f"{path}: cannot write ({error.strerror})")


def write_exr(path, channels, texts):
    """{channel: [h, w]} as 32-bit floats in a scanline file compressed by zip, with attributes {name: text}."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    render = bpy.context.scene.render
    kinds = b"".join(n.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for n in names) + b"\0"
    header = [("channels", "chlist", kinds), ("compression", "compression", b"\x03"), ("dataWindow", "box2i", box),
              ("displayWindow", "box2i", box), ("lineOrder", "lineOrder", b"\0"),
              ("pixelAspectRatio", "float", struct.pack("<f", render.pixel_aspect_x / render.pixel_aspect_y)),
              ("screenWindowCenter", "v2f", bytes(8)), ("screenWindowWidth", "float", struct.pack("<f", 1.0))]
    header += [(name, "string", text.encode()) for name, text in texts.items()]
    entry = lambda name, kind, data: name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
    start = struct.pack("<2I", 20000630, 2) + b"".join(entry(*e) for e in header) + b"\0"
    rows = np.stack([np.ascontiguousarray(channels[n], "<f4") for n in names], 1)  # [h, channels, w]
    blocks = []
    for y in range(0, height, 16):
        raw = np.frombuffer(rows[y:y + 16].tobytes(), np.uint8)
        sorted_bytes = np.concatenate([raw[::2], raw[1::2]]).astype(np.int16)
        delta = sorted_bytes.copy()
        delta[1:] += 128 - sorted_bytes[:-1]
        packed = zlib.compress(delta.astype(np.uint8).tobytes(), 6)
        packed = packed if len(packed) < raw.size else raw.tobytes()
        blocks.append(struct.pack("<2i", y, len(packed)) + packed)
    offsets = np.cumsum([len(start) + 8 * len(blocks)] + [len(b) for b in blocks[:-1]]).astype("<u8")
    write_file(path, start + offsets.tobytes() + b"".join(blocks))


def exr_parts(data):
    """Attributes {name: bytes} of each part of a file, whether it is one of several parts, and where its headers end."""
    magic, flags = struct.unpack_from("<2I", data)
    if magic != 20000630:
        raise ValueError("no OpenEXR")
    is_multipart, at = bool(flags & 0x1000), 8

    def text(at):
        end = data.index(b"\0", at)
        return data[at:end].decode(), end + 1

    parts = []
    while data[at]:
        part = {}
        while data[at]:
            name, at = text(at)
            _, at = text(at)
            size = struct.unpack_from("<I", data, at)[0]
            part[name] = data[at + 4:at + 4 + size]
            at += 4 + size
        at += 1
        parts.append(part)
        if not is_multipart:
            break
    return parts, is_multipart, at + is_multipart


def is_whole_exr(path):
    """Whether the last block of a file is there. Blender may show a file that is cut as if it were whole."""
    with open(path, "rb") as file:
        data = file.read()
    try:
        (part, *others), _, at = exr_parts(data)
        if others or "chunkCount" not in part:
            return True  # of another program, for Blender to judge
        last = max(struct.unpack_from(f"<{struct.unpack('<I', part['chunkCount'])[0]}Q", data, at))
        last += 16 if "tiles" in part else 4  # behind its place
        return last + 4 + struct.unpack_from("<I", data, last)[0] <= len(data)
    except (struct.error, ValueError, IndexError):
        return False


def read_exr(path):
    """{channel: [h, w]} of a scanline file without compression, of one part or several, as Blender writes it."""
    with open(path, "rb") as file:
        data = file.read()
    parts, is_multipart, at = exr_parts(data)
    planes, chunks = [], 0
    for part in parts:
        x0, y0, x1, y1 = struct.unpack("<4i", part["dataWindow"])
        names, place = [], 0
        while part["channels"][place]:
            end = part["channels"].index(b"\0", place)
            names.append(part["channels"][place:end].decode())
            if struct.unpack_from("<i", part["channels"], end + 1)[0] != 2 or part["compression"] != b"\0":
                raise ScriptError("expected Blender to write 32-bit floats without compression, found something else")
            place = end + 17
        planes.append((y0, names, np.zeros((y1 - y0 + 1, len(names), x1 - x0 + 1), np.float32)))
        chunks += y1 - y0 + 1
    at += 8 * chunks
    for _ in range(chunks):
        number = 0
        if is_multipart:
            number = struct.unpack_from("<i", data, at)[0]
            at += 4
        y, size = struct.unpack_from("<2i", data, at)
        y0, names, rows = planes[number]
        rows[y - y0] = np.frombuffer(data, "<f4", size // 4, at + 8).reshape(len(names), -1)
        at += 8 + size
    # The names of parts stand before those of their channels, where Blender leaves them out of these.
    result = {}
    for part, (_, names, rows) in zip(parts, planes):
        for c, name in enumerate(names):
            result[name] = rows[:, c]
    return result
