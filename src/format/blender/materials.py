# ---------------------------------------------------------------------------------------------------------------------
# Materials. Every surface shows one colour with one alpha: an emission mixed with a transparency, nothing random.

MESH_ALPHA_CAP = 1 - 1e-4
SURFACE = "Centaur surface"  # the node group at the end of every material
PIXEL = "Centaur pixel"  # the node group with the focal lengths
PROBE = "probe"  # its switch: 1 shows (1, depth, 0) instead of colours


class Graph:
    """Builds nodes from expressions; operands are sockets or numbers."""

    def __init__(self, tree):
        self.tree, self.cache = tree, {}

    def node(self, kind, **settings):
        node = self.tree.nodes.new(kind)
        count = len(self.tree.nodes)
        node.location = (180 * (count // 8), -160 * (count % 8))
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    def link(self, value, socket):
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def math(self, operation, *operands):
        key = (operation, *(o.as_pointer() if isinstance(o, bpy.types.NodeSocket) else o for o in operands))
        if key not in self.cache:
            node = self.node("ShaderNodeMath", operation=operation)
            for operand, socket in zip(operands, node.inputs):
                self.link(operand, socket)
            self.cache[key] = node.outputs[0]
        return self.cache[key]

    def vector(self, operation, a, b=None):
        node = self.node("ShaderNodeVectorMath", operation=operation)
        self.link(a, node.inputs[0])
        if b is not None:
            self.link(b, node.inputs["Scale" if operation == "SCALE" else 1])
        return node.outputs["Value" if operation in ("DOT_PRODUCT", "LENGTH") else "Vector"]

    def split(self, vector):
        node = self.node("ShaderNodeSeparateXYZ")
        self.link(vector, node.inputs[0])
        return list(node.outputs)

    def join(self, x, y, z):
        node = self.node("ShaderNodeCombineXYZ")
        for value, socket in zip((x, y, z), node.inputs):
            self.link(value, socket)
        return node.outputs[0]

    def attribute(self, name):
        return self.node("ShaderNodeAttribute", attribute_name=name, attribute_type="GEOMETRY").outputs["Vector"]

    def direction(self, name):
        """The pixel's ray, normalised, in the frame of the scene."""
        incoming = self.node("ShaderNodeNewGeometry").outputs["Incoming"]
        turn = self.node("ShaderNodeVectorTransform", vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT")
        self.link(self.vector("SCALE", incoming, -1.0), turn.inputs[0])
        return self.vector("NORMALIZE", turn.outputs[0])

    def harmonics(self, coefficients, direction):
        """max(0, 0.5 + Σ Y sh) of vector sockets."""
        xyz = self.split(direction)
        total = None
        for terms, coefficient in zip(SH_TERMS, coefficients):
            value = None
            for factor, *powers in terms:
                product = factor
                for component, power in zip(xyz, powers):
                    for _ in range(power):
                        product = self.math("MULTIPLY", product, component)
                value = product if value is None else self.math("ADD", value, product)
            part = self.vector("SCALE", coefficient, value)
            total = self.vector("ADD", (0.5, 0.5, 0.5) if total is None else total, part)
        return self.vector("MAXIMUM", total, (0.0, 0.0, 0.0))

    def linear(self, color):
        """sRGB's transfer function, per channel."""
        def channel(c):
            low = self.math("DIVIDE", c, 12.92)
            high = self.math("POWER", self.math("DIVIDE", self.math("ADD", c, 0.055), 1.055), 2.4)
            is_high = self.math("GREATER_THAN", c, 0.04045)
            return self.math("ADD", low, self.math("MULTIPLY", is_high, self.math("SUBTRACT", high, low)))
        return self.join(*map(channel, self.split(color)))

    def finish(self, color, alpha, target="ALL"):
        group = self.node("ShaderNodeGroup", node_tree=surface_group())
        self.link(color, group.inputs["Color"])
        self.link(alpha, group.inputs["Alpha"])
        self.link(group.outputs[0], self.node("ShaderNodeOutputMaterial", target=target).inputs["Surface"])


def surface_group():
    """Color and Alpha to a shader, with the switch that makes --layers measure alphas and depths instead."""
    if SURFACE in bpy.data.node_groups:
        return bpy.data.node_groups[SURFACE]
    tree = bpy.data.node_groups.new(SURFACE, "ShaderNodeTree")
    for name, direction, kind in (("Color", "INPUT", "NodeSocketVector"), ("Alpha", "INPUT", "NodeSocketFloat"),
                                  ("Surface", "OUTPUT", "NodeSocketShader")):
        tree.interface.new_socket(name, in_out=direction, socket_type=kind)
    g = Graph(tree)
    given = g.node("NodeGroupInput").outputs
    probe = g.node("ShaderNodeValue", name=PROBE, label="1: show (1, depth, 0)").outputs[0]
    probe.default_value = 0.0
    depth = g.node("ShaderNodeCameraData").outputs["View Z Depth"]
    probed = g.vector("SCALE", g.join(1.0, depth, 0.0), probe)
    shown = g.vector("ADD", g.vector("SCALE", given["Color"], g.math("SUBTRACT", 1.0, probe)), probed)
    emission, clear, mix = (g.node(f"ShaderNode{kind}") for kind in ("Emission", "BsdfTransparent", "MixShader"))
    g.link(shown, emission.inputs["Color"])
    g.link(given["Alpha"], mix.inputs[0])
    g.link(clear.outputs[0], mix.inputs[1])
    g.link(emission.outputs[0], mix.inputs[2])
    g.link(mix.outputs[0], g.node("NodeGroupOutput").inputs[0])
    return tree


def new_material(name):
    material = bpy.data.materials.new(name)
    if not material.node_tree:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    material.use_backface_culling = False
    material.surface_render_method = "BLENDED"  # of EEVEE: in the order of the faces, not by noise
    return material, Graph(material.node_tree)


def within(g, alpha, cap, cut):
    """min(alpha, cap), and 0 below the cut."""
    return g.math("MULTIPLY", g.math("MINIMUM", alpha, cap), g.math("SUBTRACT", 1.0, g.math("LESS_THAN", alpha, cut)))


def ewa_material(name):
    material, g = new_material(name)
    u, v, opacity = g.split(g.attribute("ewa"))
    squared = g.math("ADD", g.math("MULTIPLY", u, u), g.math("MULTIPLY", v, v))
    alpha = g.math("MULTIPLY", opacity, g.math("EXPONENT", g.math("MULTIPLY", squared, -0.5)))
    g.finish(g.attribute("shade"), within(g, alpha, ALPHA_CAP, ALPHA_CUT))
    return material


def from_camera(g):
    """The vector from the camera to the surface, in the scene."""
    place = g.node("ShaderNodeVectorTransform", vector_type="POINT", convert_from="CAMERA", convert_to="OBJECT")
    place.inputs[0].default_value = (0.0, 0.0, 0.0)
    return g.vector("SUBTRACT", g.node("ShaderNodeTexCoord").outputs["Object"], place.outputs[0])


def beyond(g, alpha, depth, near):
    """Alpha, 0 for depths up to `near`."""
    return g.math("MULTIPLY", alpha, g.math("GREATER_THAN", depth, near))


def ray_material(name, coefficients, decode, is_shell, near):
    """Alpha from the smallest Mahalanobis distance on the ray. `coefficients` of SH to evaluate, 0 for colours as given."""
    material, g = new_material(name)
    position = g.node("ShaderNodeTexCoord").outputs["Object"]
    direction = g.direction("ray")
    rows = [g.attribute(f"whiten_{i}") for i in range(3)]
    whitened = lambda v: g.join(*(g.vector("DOT_PRODUCT", row, v) for row in rows))
    o, d = whitened(g.vector("SUBTRACT", position, g.attribute("mean"))), whitened(direction)
    t = g.math("DIVIDE", g.math("MULTIPLY", g.vector("DOT_PRODUCT", o, d), -1.0), g.vector("DOT_PRODUCT", d, d))
    peak = g.vector("ADD", o, g.vector("SCALE", d, t))
    response = g.math("EXPONENT", g.math("MULTIPLY", g.vector("DOT_PRODUCT", peak, peak), -0.5))
    opacity = g.node("ShaderNodeAttribute", attribute_name="opacity", attribute_type="GEOMETRY").outputs["Fac"]
    alpha = within(g, g.math("MULTIPLY", opacity, response), ALPHA_CAP, ALPHA_CUT)
    # The peak lies t behind the hit.
    behind = g.math("ADD", 1.0, g.math("DIVIDE", t, g.vector("LENGTH", from_camera(g))))
    alpha = beyond(g, alpha, g.math("MULTIPLY", g.node("ShaderNodeCameraData").outputs["View Z Depth"], behind), near)
    if is_shell:
        back = g.node("ShaderNodeNewGeometry").outputs["Backfacing"]
        alpha = g.math("MULTIPLY", alpha, g.math("SUBTRACT", 1.0, back))
    if coefficients:
        color = g.harmonics([g.attribute(f"sh_{k}") for k in range(coefficients)], direction)
        color = g.linear(color) if decode else color
    else:
        color = g.attribute("shade")
    g.finish(color, alpha)
    return material


def pixel_group():
    """How much of a surface a pixel covers: the focal lengths of the active camera, in pixels."""
    if PIXEL not in bpy.data.node_groups:
        tree = bpy.data.node_groups.new(PIXEL, "ShaderNodeTree")
        g = Graph(tree)
        output = g.node("NodeGroupOutput")
        for name in ("fx", "fy"):
            tree.interface.new_socket(name, in_out="OUTPUT", socket_type="NodeSocketFloat")
            g.link(g.node("ShaderNodeValue", name=name, label=name).outputs[0], output.inputs[name])
    return bpy.data.node_groups[PIXEL]


def set_focal_lengths(fx, fy):
    if PIXEL in bpy.data.node_groups:
        for name, value in (("fx", fx), ("fy", fy)):
            socket = bpy.data.node_groups[PIXEL].nodes[name].outputs[0]
            if abs(socket.default_value - value) > 1e-6 * value:
                socket.default_value = value


def footprint(g):
    """How far texture coordinates move from a pixel to the next: [(u, v) along x, (u, v) along y]. A pinhole sees planes:

    with the surface at v from the camera and the camera's axis X, a pixel moves it by depth/fx · (X - v (n·X)/(n·v)). The depth
    is the camera's; all else is in the frame of the object, where X has another length if the object is scaled.
    """
    def in_object(vector):
        turn = g.node("ShaderNodeVectorTransform", vector_type="VECTOR", convert_from="CAMERA", convert_to="OBJECT")
        turn.inputs[0].default_value = vector
        return turn.outputs[0]

    along = from_camera(g)
    normal, gradients = g.attribute("face_normal"), [g.attribute("gradient_u"), g.attribute("gradient_v")]
    axes = [in_object(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))]
    depth = g.node("ShaderNodeCameraData").outputs["View Z Depth"]
    facing = g.vector("DOT_PRODUCT", normal, along)
    focal = g.node("ShaderNodeGroup", node_tree=pixel_group()).outputs
    moved = []
    for axis, name in zip(axes, ("fx", "fy")):
        slope = g.math("DIVIDE", g.vector("DOT_PRODUCT", normal, axis), facing)
        step = g.vector("SUBTRACT", axis, g.vector("SCALE", along, slope))
        size = g.math("DIVIDE", depth, focal[name])
        moved.append([g.math("MULTIPLY", g.vector("DOT_PRODUCT", gradient, step), size) for gradient in gradients])
    return moved


def level_of_detail(g, moved, size, levels):
    """log2 of the longest axis of the ellipse that a pixel covers, in texels, within 0 and the coarsest level."""
    (sx, tx), (sy, ty) = ([g.math("MULTIPLY", value, float(texels)) for value, texels in zip(uv, size)] for uv in moved)
    times = lambda p, q: g.math("MULTIPLY", p, q)
    plus = lambda p, q: g.math("ADD", p, q)
    a, b, c = plus(times(sx, sx), times(tx, tx)), plus(times(sy, sy), times(ty, ty)), plus(times(sx, sy), times(tx, ty))
    half = times(g.math("SUBTRACT", a, b), 0.5)
    longest = plus(times(plus(a, b), 0.5), g.math("SQRT", plus(times(half, half), times(c, c))))
    level = times(g.math("LOGARITHM", g.math("MAXIMUM", longest, 1e-30), 2.0), 0.5)
    return g.math("MINIMUM", g.math("MAXIMUM", level, 0.0), float(levels - 1))


def mesh_material(name, maps, decode, near):
    """`maps`: of every SH coefficient the images of its mip levels, with the logit of opacity in the first one's alpha.

    They hold what is before activation, and are interpolated before it.
    """
    material, g = new_material(name)
    uv = g.node("ShaderNodeUVMap", uv_map="UVMap").outputs[0]
    moved = footprint(g) if max(map(len, maps)) > 1 else None
    weights = {}

    def weight(images, level):
        """Of a level between the two next to the level of detail."""
        key = (*images[0].size, len(images))
        if key not in weights:
            detail = level_of_detail(g, moved, images[0].size, len(images))
            weights[key] = [g.math("MAXIMUM", 0.0, g.math("SUBTRACT", 1.0, g.math("ABSOLUTE", g.math("SUBTRACT", detail, float(m)))))
                            for m in range(len(images))]
        return weights[key][level]

    colors, logit, finest = [], None, None
    for images in maps:
        color = None
        for level, image in enumerate(images):
            node = g.node("ShaderNodeTexImage", image=image, interpolation="Linear", extension="EXTEND")
            g.link(uv, node.inputs[0])
            finest = finest or node
            part, alpha = node.outputs["Color"], node.outputs["Alpha"]
            if len(images) > 1:
                part = g.vector("SCALE", part, weight(images, level))
                alpha = g.math("MULTIPLY", alpha, weight(images, level)) if images is maps[0] else None
            color = part if color is None else g.vector("ADD", color, part)
            if images is maps[0]:
                logit = alpha if logit is None else g.math("ADD", logit, alpha)
        colors.append(color)
    opacity = lambda x: g.math("DIVIDE", 1.0, g.math("ADD", 1.0, g.math("EXPONENT", g.math("MULTIPLY", g.math("MAXIMUM", x, -60.0), -1.0))))
    alpha, color = opacity(logit), g.harmonics(colors, g.direction("ray"))
    # EEVEE has few texture units: the first map at its finest level.
    plain = g.harmonics([finest.outputs["Color"]], (0.0, 0.0, 1.0))
    g.finish(g.linear(plain) if decode else plain, g.math("MINIMUM", opacity(finest.outputs["Alpha"]), MESH_ALPHA_CAP), "EEVEE")
    alpha = beyond(g, g.math("MINIMUM", alpha, MESH_ALPHA_CAP), g.node("ShaderNodeCameraData").outputs["View Z Depth"], near)
    g.finish(g.linear(color) if decode else color, alpha, "CYCLES")
    return material
