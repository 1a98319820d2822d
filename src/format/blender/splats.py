# ---------------------------------------------------------------------------------------------------------------------
# Splats as triangles. Only numpy; all in the frame of the scene, cameras in OpenCV axes (x right, y down, z forward).

ALPHA_CAP, ALPHA_CUT, JACOBIAN_MARGIN = 0.99, 1 / 255, 0.3


class ScriptError(Exception):
    """What is told to the user in one line."""


class Splats:
    """mean [N, 3], rotation [N, 4] (w, x, y, z), scale [N, 3] (standard deviations), opacity [N], sh [N, K, 3]."""

    def __init__(self, mean, rotation, scale, opacity, sh):
        self.mean, self.rotation, self.scale, self.opacity, self.sh = (
            np.asarray(a, np.float64) for a in (mean, rotation, scale, opacity, sh))

    def __len__(self):
        return len(self.mean)

    def __getitem__(self, which):
        return Splats(self.mean[which], self.rotation[which], self.scale[which], self.opacity[which], self.sh[which])

    def axes(self):
        """Rotation matrices [N, 3, 3]; column i is local axis i."""
        w, x, y, z = (self.rotation / np.linalg.norm(self.rotation, axis=1, keepdims=True)).T
        rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
        return np.moveaxis(np.array(rows), 2, 0)


class View:
    """What is seen from where: p_camera = rotation · p_scene + translation; focal lengths and centre in pixels."""

    def __init__(self, width, height, fx, fy, cx, cy, rotation, translation, near):
        self.width, self.height, self.fx, self.fy, self.cx, self.cy = width, height, fx, fy, cx, cy
        self.rotation, self.translation, self.near = np.asarray(rotation), np.asarray(translation), near
        self.center = -self.rotation.T @ self.translation

    def to_camera(self, points):
        return points @ self.rotation.T + self.translation

    def to_scene(self, points):
        return (points - self.translation) @ self.rotation


def read_ply(path):
    """{element: structured array} of a binary little-endian PLY; lists must have three entries."""
    kinds = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1", "char": "i1", "int": "<i4",
             "int32": "<i4", "uint": "<u4", "uint32": "<u4", "short": "<i2", "ushort": "<u2"}
    try:
        file = open(path, "rb")
    except OSError as error:
        raise ScriptError(f"{path}: cannot read ({error.strerror}); it lies beside the script where `centaur convert` wrote it")
    with file:
        elements = []
        for line in iter(file.readline, b""):
            words = line.decode("ascii", "replace").split()
            if words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].extend([("count", kinds[words[2]]), (words[4], kinds[words[3]], 3)])
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], kinds[words[1]]))
            elif words[:1] == ["end_header"]:
                break
        tables = {name: np.fromfile(file, np.dtype(fields), count) for name, count, fields in elements}
    for name, count, _ in elements:
        if len(tables[name]) != count:
            raise ScriptError(f"{path}: expected {count} of `{name}`, found {len(tables[name])}: the file is cut")
    return tables


def read_splats(path):
    """The 3DGS layout: logarithms of scales, logits of opacities, SH by channel."""
    table = read_ply(path)["vertex"]
    columns = lambda *names: np.stack([table[n] for n in names], 1).astype(np.float64)
    rest = [n for n in table.dtype.names if n.startswith("f_rest_")]
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        by_channel = columns(*(f"f_rest_{i}" for i in range(len(rest)))).reshape(len(table), 3, -1)
        sh = np.concatenate([sh, by_channel.transpose(0, 2, 1)], 1)
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-table["opacity"].astype(np.float64)))
    return Splats(columns("x", "y", "z"), columns("rot_0", "rot_1", "rot_2", "rot_3"),
                  np.maximum(np.exp(columns("scale_0", "scale_1", "scale_2")), np.finfo(np.float32).tiny), opacity, sh)


def sh_basis(d):
    """The real spherical harmonics of 3DGS at unit directions [..., 3] -> [..., 16]."""
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    return np.stack([sum(c * x**i * y**j * z**k for c, i, j, k in terms) for terms in SH_TERMS], -1)


# Each function as a sum of (factor, powers of x, y, z); the materials evaluate the same table.
SH_TERMS = (
    ((0.28209479177387814, 0, 0, 0),),
    ((-0.4886025119029199, 0, 1, 0),),
    ((0.4886025119029199, 0, 0, 1),),
    ((-0.4886025119029199, 1, 0, 0),),
    ((1.0925484305920792, 1, 1, 0),),
    ((-1.0925484305920792, 0, 1, 1),),
    ((0.6307831305050401, 0, 0, 2), (-0.31539156525252005, 2, 0, 0), (-0.31539156525252005, 0, 2, 0)),
    ((-1.0925484305920792, 1, 0, 1),),
    ((0.5462742152960396, 2, 0, 0), (-0.5462742152960396, 0, 2, 0)),
    ((-1.7701307697799304, 2, 1, 0), (0.5900435899266435, 0, 3, 0)),
    ((2.890611442640554, 1, 1, 1),),
    ((-1.8281831978578632, 0, 1, 2), (0.4570457994644658, 2, 1, 0), (0.4570457994644658, 0, 3, 0)),
    ((0.7463526651802308, 0, 0, 3), (-1.1195289977703462, 2, 0, 1), (-1.1195289977703462, 0, 2, 1)),
    ((-1.8281831978578632, 1, 0, 2), (0.4570457994644658, 3, 0, 0), (0.4570457994644658, 1, 2, 0)),
    ((1.445305721320277, 2, 0, 1), (-1.445305721320277, 0, 2, 1)),
    ((-0.5900435899266435, 3, 0, 0), (1.7701307697799304, 1, 2, 0)),
)


def srgb_to_linear(c):
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0) + 0.055) / 1.055) ** 2.4)


def colors(splats, view, decode):
    """Colours [N, 3] as seen from the camera's centre, in linear light if `decode`."""
    toward = splats.mean - view.center
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-300)
    count = splats.sh.shape[1]
    rgb = np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", sh_basis(toward)[:, :count], splats.sh))
    return srgb_to_linear(rgb) if decode else rgb


class Triangles:
    """points [V, 3], faces [F, 3 or 4] and, by name, attributes of points [V, width]."""

    def __init__(self, points, faces, attributes):
        self.points, self.faces, self.attributes = points, faces, attributes


def reach(opacity):
    """Mahalanobis distance at which alpha falls below the cut, a little more for rounding; 0 where it never reaches it."""
    return np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_CUT, 1))) * 1.0005


CELLS = 64  # of the picture, along each side


def separated(depth, low, high):
    """Depths, front to back, moved so far apart that a ray tracer in single precision tells splats apart that overlap.

    Cycles goes on one representable number behind a transparent hit, so what lies closer is lost or swapped. The gap is
    2e-6 of the depth, between splats whose boxes, from `low` to `high` in a picture of 0..1, share a cell of a grid. All others
    keep their depths, and none moves by more than a thousandth, so that millions of splats are not moved behind surfaces.
    """
    first = np.clip(np.floor(low * CELLS), 0, CELLS - 1).astype(int).tolist()
    beyond = np.clip(np.floor(high * CELLS) + 1, 1, CELLS).astype(int).tolist()
    last, moved = np.zeros((CELLS, CELLS)), []
    for z, (u0, v0), (u1, v1) in zip(depth.tolist(), first, beyond):
        cells = last[v0:v1, u0:u1]
        cells[:] = z = max(z, min(cells.max() * (1 + 2e-6), z * 1.001))
        moved.append(z)
    return np.array(moved)


def ewa(splats, view, decode, low_pass):
    """The raster model: a quad per splat in the plane at its depth, so that they are hit in the order of their means.

    Attribute `ewa` holds the offset from the mean in standard deviations of the projected Gaussian, and opacity. `low_pass` is
    the variance that projections are widened by, in square pixels, and whether splats keep their integral.
    """
    p = view.to_camera(splats.mean)
    kept = (p[:, 2] > view.near) & (splats.opacity >= ALPHA_CUT)
    splats, p = splats[kept], p[kept]
    # In single precision, as Blender places cameras: what is at one depth stays in the order of the file.
    order = np.argsort(p[:, 2].astype(np.float32), kind="stable")
    splats, p = splats[order], p[order]
    x, y, z = p.T
    margin = 0.5 * JACOBIAN_MARGIN * np.array([view.width, view.height])
    xh = z * np.clip(x / z, (-view.cx - margin[0]) / view.fx, (view.width - view.cx + margin[0]) / view.fx)
    yh = z * np.clip(y / z, (-view.cy - margin[1]) / view.fy, (view.height - view.cy + margin[1]) / view.fy)
    zero = np.zeros_like(z)
    jacobian = np.stack([np.stack([view.fx / z, zero, -view.fx * xh / z**2], -1),
                         np.stack([zero, view.fy / z, -view.fy * yh / z**2], -1)], 1)
    spread = jacobian @ view.rotation @ (splats.axes() * splats.scale[:, None])
    narrow = spread @ spread.transpose(0, 2, 1)
    covariance = narrow + low_pass[0] * np.eye(2)
    if low_pass[1]:
        kept_part = np.sqrt(np.maximum(np.linalg.det(narrow), 0) / np.linalg.det(covariance))
        splats = Splats(splats.mean, splats.rotation, splats.scale, splats.opacity * kept_part, splats.sh)
    variance, direction = np.linalg.eigh(covariance)
    half = direction * (reach(splats.opacity)[:, None] * np.sqrt(variance))[:, None]
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    center = np.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], -1)
    pixels = center[:, None] + np.einsum("nij,kj->nki", half, signs)
    # What lies outside the picture is left out; the order of faces, back to front, is the one in which EEVEE draws.
    low, high = pixels.min(1), pixels.max(1)
    seen = (high >= 0).all(1) & (low[:, 0] <= view.width) & (low[:, 1] <= view.height)
    seen = np.flatnonzero(seen & (splats.opacity >= ALPHA_CUT))
    size = np.array([view.width, view.height])
    depth, seen = separated(z[seen], low[seen] / size, high[seen] / size)[::-1], seen[::-1]
    splats, pixels = splats[seen], pixels[seen]
    corners = np.stack([(pixels[..., 0] - view.cx) / view.fx, (pixels[..., 1] - view.cy) / view.fy,
                        np.ones(pixels.shape[:2])], -1) * depth[:, None, None]
    local = np.empty((len(splats), 4, 3))
    local[:, :, :2] = reach(splats.opacity)[:, None, None] * signs
    local[:, :, 2] = splats.opacity[:, None]
    attributes = {"ewa": local.reshape(-1, 3), "shade": np.repeat(colors(splats, view, decode), 4, 0)}
    return Triangles(view.to_scene(corners.reshape(-1, 3)), np.arange(4 * len(splats)).reshape(-1, 4), attributes)


def rings(count):
    """Rings of 6, 12, 18 … points around one: radii in 0..1 and angles of the points, and the triangles between them."""
    radii, angles, faces = [0.0], [0.0], []
    first = lambda ring: 1 + 3 * ring * (ring - 1) if ring else 0
    at = lambda ring, i: first(ring) + i % (6 * ring) if ring else 0
    for ring in range(1, count + 1):
        radii += [ring / count] * (6 * ring)
        angles += [2 * np.pi * i / (6 * ring) for i in range(6 * ring)]
        for sector in range(6):
            for i in range(ring):
                outer, inner = sector * ring + i, sector * (ring - 1) + i
                faces.append((at(ring, outer), at(ring, outer + 1), at(ring - 1, inner)))
                if i + 1 < ring:
                    faces.append((at(ring - 1, inner), at(ring, outer + 1), at(ring - 1, inner + 1)))
    return np.array(radii), np.array(angles), np.array(faces)


def whitening(splats):
    """Rows [N, 3, 3] of the map from offsets in the scene to standard deviations along the splat's axes."""
    return splats.axes().transpose(0, 2, 1) / splats.scale[:, :, None]


def least_scales(splats, view, part):
    """Scales [N, 3] of splats, none below a part of the distance from the camera."""
    return np.maximum(splats.scale, part * np.linalg.norm(splats.mean - view.center, axis=1)[:, None])


def ray_attributes(splats, view, decode, sh_direction):
    """What the material of the ray model needs of every splat."""
    # Beyond 1e19 squares overflow in single precision; a billionth of the distance is as flat as 0.
    scale = least_scales(splats, view, 1e-9)
    whiten = whitening(Splats(splats.mean, splats.rotation, scale, splats.opacity, splats.sh))
    attributes = {"mean": splats.mean, "opacity": splats.opacity[:, None]}
    attributes.update({f"whiten_{i}": whiten[:, i] for i in range(3)})
    if sh_direction == "ray":
        attributes.update({f"sh_{k}": splats.sh[:, k] for k in range(splats.sh.shape[1])})
    else:
        attributes["shade"] = colors(splats, view, decode)
    return attributes


def joined(parts):
    """One of several; at least one."""
    starts = np.cumsum([0] + [len(p.points) for p in parts])
    return Triangles(np.concatenate([p.points for p in parts]),
                     np.concatenate([p.faces + start for p, start in zip(parts, starts)]),
                     {name: np.concatenate([p.attributes[name] for p in parts]) for name in parts[0].attributes})


def instanced(local, faces, splats, view, decode, sh_direction):
    """A patch of points [N, P, 3] in standard deviations for every splat, in the scene."""
    n, count = local.shape[:2]
    points = splats.mean[:, None] + np.einsum("nij,npj->npi", splats.axes() * splats.scale[:, None], local)
    faces = (faces[None] + count * np.arange(n)[:, None, None]).reshape(-1, 3)
    attributes = ray_attributes(splats, view, decode, sh_direction)
    return Triangles(points.reshape(-1, 3), faces, {name: np.repeat(a, count, 0) for name, a in attributes.items()})


def cap(splats, view, decode, sh_direction, budget):
    """The ray model: for every splat the surface of the peaks along all rays from the camera, so that a ray hits it where
    its response is highest. In standard deviations that is a sphere through the camera and the mean.

    The finer the patches, the better the order of splats that are close to each other: facets are as small as `budget`
    triangles in all allow. The material computes alpha from the ray, whatever the facets.
    """
    ahead = view.to_camera(splats.mean)[:, 2]
    twins, rank, most = twins_of(splats)
    toward = np.einsum("nij,nj->ni", whitening(splats), view.center - splats.mean)
    distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-12)
    limit = reach(most)
    kept = (splats.opacity >= ALPHA_CUT) & (ahead > view.near)
    order = np.flatnonzero(kept)[np.argsort(-ahead[kept], kind="stable")]
    splats, toward, distance, limit = splats[order], toward[order], distance[order], limit[order]
    twins, apart = twins[order], 1 + TWINS_APART * rank[order]
    parts = []
    around = limit > 0.9 * distance
    if around.any():
        parts.append(screens(splats[around], view, decode, sh_direction, limit[around], apart[around], budget // 2))
        rest = ~around
        splats, toward, distance, limit, twins, apart = (a[rest] for a in (splats, toward, distance, limit, twins, apart))
        budget -= len(parts[0].faces)
    # Angles a as asinh(tan a): alike where they are small; where the camera is within a splat, depths, which go with
    # cos a, fall evenly in their logarithms. Facets of side h lie up to h²/8 beside the surface, relative to the
    # distance.
    sine = np.minimum(limit / distance, 1 - 1e-9)
    angle = np.arcsinh(sine / np.sqrt(1 - sine**2))
    for error in 10.0 ** np.arange(-6, 0, 0.1):
        count = np.clip(np.ceil(angle / np.sqrt(8 * error)), 1, 32).astype(int)
        if 6 * (count**2).sum() <= budget:
            break
    axis = toward / distance[:, None]
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(axis, side)
    # Every patch is turned differently: edges of many on one line would meet the same ray.
    turn = 2.399963 * twins
    for k in np.unique(count):
        these = count == k
        radii, angles, faces = rings(int(k))
        outer = np.arcsinh(np.sinh(angle[these]) / np.cos(np.pi / (6 * k)))
        theta = np.arctan(np.sinh(outer[:, None] * radii))
        phi = angles + turn[these][:, None]
        d = distance[these][:, None]
        across, along = d * np.sin(theta) * np.cos(theta), d * np.sin(theta) ** 2
        local = (across * np.cos(phi))[..., None] * side[these][:, None] + (across * np.sin(phi))[..., None] * up[these][:, None]
        local += along[..., None] * axis[these][:, None]
        part = instanced(local, faces, splats[these], view, decode, sh_direction)
        away = np.repeat(apart[these], len(radii))[:, None]
        part.points = view.center + (part.points - view.center) * away
        parts.append(part)
    return joined(parts) if parts else instanced(np.zeros((0, 1, 3)), np.zeros((0, 3), int), splats, view, decode, sh_direction)


TWINS_APART = 1e-5  # relative to the distance: twice the gap at which Cycles tells surfaces apart, and room for rounding


def twins_of(splats):
    """Of splats of one place and shape, which have no order by depth: a number for each such shape, the rank of a splat among
    those of its shape, and their highest opacity. They get the same patch, one behind the other in the order of the splats."""
    shape = np.concatenate([splats.mean, splats.rotation, splats.scale], 1)
    _, number = np.unique(shape, axis=0, return_inverse=True)
    number = number.ravel()
    order = np.argsort(number, kind="stable")
    first = np.concatenate([[True], np.diff(number[order]) > 0]) if len(order) else np.zeros(0, bool)
    rank = np.empty(len(number), int)
    rank[order] = np.arange(len(number)) - np.maximum.accumulate(np.where(first, np.arange(len(number)), 0))
    most = np.zeros(len(number))
    np.maximum.at(most, number, splats.opacity)
    return number, rank, most[number]


def screens(splats, view, decode, sh_direction, limit, apart, budget):
    """As `cap` for splats that the camera is in or nearly in: patches over the picture, of quads a few pixels wide."""
    margin, parts = 2, []
    for step in (1, 1.5, 2, 3, 4, 6, 8, 12, 16):
        # No corner and no edge of a facet at the centre of a pixel.
        u, v = (np.arange(-margin, side + margin + step, step) + shift for side, shift in ((view.width, 0.27), (view.height, 0.39)))
        if 2 * len(u) * len(v) * len(splats) <= budget:
            break
    x, y = np.meshgrid((u - view.cx) / view.fx, (v - view.cy) / view.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ view.rotation
    corner = np.arange(len(u) * len(v)).reshape(len(v), len(u))
    cells = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], -1).reshape(-1, 4)
    whiten = whitening(splats)
    for i in range(len(splats)):
        o, d = whiten[i] @ (view.center - splats.mean[i]), rays @ whiten[i].T
        t = -(d @ o) / (d * d).sum(1)
        squared = ((o + t[:, None] * d) ** 2).sum(1)
        # The material leaves out what is not there.
        seen = ((squared[cells].min(1) <= (1.1 * limit[i]) ** 2) & (t[cells].max(1) > 0.9 * view.near))
        used, faces = np.unique(cells[seen], return_inverse=True)
        faces = faces.reshape(-1, 4)
        points = view.center + rays[used] * (np.maximum(t[used], 0.5 * view.near) * apart[i])[:, None]
        attributes = ray_attributes(splats[i:i + 1], view, decode, sh_direction)
        parts.append(Triangles(points, np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]),
                               {name: np.repeat(a, len(points), 0) for name, a in attributes.items()}))
    return joined(parts)


def shell(splats, view, decode, sh_direction):
    """The ray model without a camera: an ellipsoid around every splat, ordered by where rays enter it."""
    golden = (1 + 5**0.5) / 2
    corners = [(s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array([np.roll((0, s, t), k) for k in range(3) for s, t in corners], float)
    points /= np.linalg.norm(points[0])
    near = np.linalg.norm(points[:, None] - points, axis=2) < 1.06
    faces = np.array([(i, j, k) for i in range(12) for j in range(i + 1, 12) for k in range(j + 1, 12)
                      if near[i, j] and near[j, k] and near[i, k]])
    middle = points[faces].mean(1)
    outward = np.einsum("fi,fi->f", np.cross(points[faces[:, 1]] - points[faces[:, 0]],
                                             points[faces[:, 2]] - points[faces[:, 0]]), middle)
    faces[outward < 0] = faces[outward < 0][:, ::-1]
    splats = splats[splats.opacity >= ALPHA_CUT]
    local = points * (reach(splats.opacity) / np.linalg.norm(middle[0]))[:, None, None]
    # Flat splats are made so thick that rays enter them before they leave; alpha is computed from their true scales.
    local *= (least_scales(splats, view, 1e-6) / splats.scale)[:, None]
    return instanced(local, faces, splats, view, decode, sh_direction)


def deepest(triangles, view):
    """At most how many patches lie behind one another, by their bounding boxes on a coarse grid of the picture."""
    size = triangles.faces.shape[1]
    if size != 4 or not len(triangles.faces):
        return 0
    p = view.to_camera(triangles.points).reshape(-1, 4, 3)
    u = (view.fx * p[..., 0] / p[..., 2] + view.cx) / view.width
    v = (view.fy * p[..., 1] / p[..., 2] + view.cy) / view.height
    cells = 64
    edge = lambda values, extra: np.clip(np.floor(values * cells + 0.5), 0, cells).astype(int) + extra
    counts = np.zeros((cells + 2, cells + 2), int)
    u0, u1, v0, v1 = edge(u.min(1), 0), edge(u.max(1), 0), edge(v.min(1), 0), edge(v.max(1), 0)
    for rows, columns, sign in ((v0, u0, 1), (v1, u0, -1), (v0, u1, -1), (v1, u1, 1)):
        np.add.at(counts, (rows, columns), sign)
    return int(counts.cumsum(0).cumsum(1).max())
