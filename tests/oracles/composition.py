#!/usr/bin/env python3
"""The composition of EXT_gaussian_splatting_hybrid in numpy, written from the extension's README alone.

Not implemented: skins, morph targets, bindings, fields, images as texels. check_composition.py compares it with
Centaur.
"""
import itertools
import json
import pathlib

import numpy as np

EXT, KHR = "EXT_gaussian_splatting_hybrid", "KHR_gaussian_splatting"


# --- glTF ---

class Asset:
    """A binary glTF file: its JSON, and the numbers in its accessors."""

    def __init__(self, path):
        data = pathlib.Path(path).read_bytes()
        size = int.from_bytes(data[12:16], "little")
        self.json = json.loads(data[20:20 + size])
        self.bin = data[28 + size:]

    def write(self, path):
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        chunks = b"".join(len(c).to_bytes(4, "little") + k + c for k, c in [(b"JSON", text), (b"BIN\0", self.bin)])
        path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks)

    def accessor(self, index):
        a = self.json["accessors"][index]
        view = self.json["bufferViews"][a["bufferView"]]
        kind = np.dtype({5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[a["componentType"]])
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[a["type"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        stride = view.get("byteStride", width * kind.itemsize)
        values = np.ndarray((a["count"], width), kind, self.bin, start, (stride, kind.itemsize)).astype(np.float64)
        if a.get("normalized"):
            values = np.maximum(values / np.iinfo(kind).max, -1)
        return values[:, 0] if width == 1 else values

    def nodes(self):
        """Nodes as (node, global transform) in document order."""
        scene = self.json["scenes"][self.json.get("scene", 0)]
        stack = [(i, np.eye(4)) for i in reversed(scene["nodes"])]
        while stack:
            index, parent = stack.pop()
            node = self.json["nodes"][index]
            matrix = parent @ local_transform(node)
            stack += [(i, matrix) for i in reversed(node.get("children", []))]
            yield node, matrix


def local_transform(node):
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    result = np.eye(4)
    result[:3, :3] = rotations(np.array([node.get("rotation", [0, 0, 0, 1])], float))[0] * node.get("scale", [1, 1, 1])
    result[:3, 3] = node.get("translation", [0, 0, 0])
    return result


def rotations(q):
    """Matrices of unit quaternions (x, y, z, w)."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return np.moveaxis(np.array(rows), 2, 0)


def orthogonal(matrix):
    """The orthogonal polar factor of the linear part: a rotation, or with a mirroring transform a rotation and a
    reflection."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return u @ vt


def sh_basis(d):
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    c1, c2, c3 = 0.4886025119029199, 1.0925484305920792, 0.4570457994644658
    return np.stack([
        np.full_like(x, 0.28209479177387814), -c1 * y, c1 * z, -c1 * x,
        c2 * x * y, -c2 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y), -c2 * x * z,
        0.5 * c2 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z, -c3 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y), -c3 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)], -1)


# --- View ---

class View:
    """Image size, calibration and pose of the asset's first camera."""

    def __init__(self, asset):
        node, matrix = next((n, m) for n, m in asset.nodes() if "camera" in n)
        camera = asset.json["cameras"][node["camera"]]
        own = camera.get("extras", {}).get("centaur")  # README, Known Implementations: another source of the numbers
        lens = camera["perspective"]
        if own:
            self.w, self.h, self.fx, self.fy, self.cx, self.cy = (own[k] for k in ["width", "height", "fx", "fy", "cx", "cy"])
        else:
            self.h = 480
            self.w = round(self.h * lens["aspectRatio"])
            self.fy, self.cx, self.cy = 0.5 * self.h / np.tan(0.5 * lens["yfov"]), self.w / 2, self.h / 2
            self.fx = self.w / (2 * lens["aspectRatio"] * np.tan(0.5 * lens["yfov"]))
        self.name, self.znear = node.get("name"), lens["znear"]
        self.rotation = (orthogonal(matrix) * [1, -1, -1]).T
        self.center = matrix[:3, 3]

    def to_camera(self, points):
        return (points - self.center) @ self.rotation.T

    def rays(self, i, j):
        """Camera-space rays with z = 1 through the centres of pixels."""
        return np.stack([(i + 0.5 - self.cx) / self.fx, (j + 0.5 - self.cy) / self.fy, np.ones(np.shape(i))], -1)


# --- Splats ---

def project_splats(asset, view, near, footprint={}):
    """Depth, centre, inverse covariance, opacity and colour of the splats that are drawn, front to back."""
    parts = []
    for node, matrix in asset.nodes():
        for primitive in asset.json["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            if KHR not in primitive.get("extensions", {}):
                continue
            get = lambda name: asset.accessor(primitive["attributes"][name])
            mean = get("POSITION") @ matrix[:3, :3].T + matrix[:3, 3]
            names = [f"{KHR}:SH_DEGREE_{l}_COEF_{m}" for l in range(4) for m in range(2 * l + 1)]
            sh = np.stack([get(n) for n in names if n in primitive["attributes"]], 1)
            d = mean - view.center
            d = d / np.linalg.norm(d, axis=1, keepdims=True) @ orthogonal(matrix)
            color = np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", sh_basis(d)[:, :sh.shape[1]], sh))
            axes = matrix[:3, :3] @ rotations(get(f"{KHR}:ROTATION")) * get(f"{KHR}:SCALE")[:, None, :]
            parts.append((mean, axes, get(f"{KHR}:OPACITY"), color))
    if not parts:
        return []
    mean, axes, opacity, color = (np.concatenate(p) for p in zip(*parts))
    t = view.to_camera(mean)
    drawn = (t[:, 2] > near) & (opacity >= 1 / 255)
    t, axes, opacity, color = t[drawn], axes[drawn], opacity[drawn], color[drawn]
    x, y, z = t.T
    xh = z * np.clip(x / z, (-view.cx - 0.15 * view.w) / view.fx, (view.w - view.cx + 0.15 * view.w) / view.fx)
    yh = z * np.clip(y / z, (-view.cy - 0.15 * view.h) / view.fy, (view.h - view.cy + 0.15 * view.h) / view.fy)
    zero = np.zeros_like(z)
    jacobian = np.stack([np.stack([view.fx / z, zero, -view.fx * xh / z**2], -1),
                         np.stack([zero, view.fy / z, -view.fy * yh / z**2], -1)], 1)
    m = jacobian @ view.rotation @ axes
    exact = m @ m.transpose(0, 2, 1)
    covariance = exact + footprint.get("variance", 0.3) * np.eye(2)
    if footprint.get("normalized", False):
        opacity = opacity * np.sqrt(np.maximum(np.linalg.det(exact), 0) / np.linalg.det(covariance))
        drawn = opacity >= 1 / 255
        t, opacity, color, covariance, x, y, z = (
            a[drawn] for a in (t, opacity, color, covariance, x, y, z))
    center = np.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], -1)
    # Half width and height of the ellipse on which alpha is 1/255.
    reach = np.sqrt(2 * np.log(255 * opacity)[:, None] * np.stack([covariance[:, 0, 0], covariance[:, 1, 1]], -1))
    order = np.argsort(z, kind="stable")
    return [a[order] for a in (z, center, np.linalg.inv(covariance), opacity, color, reach)]


# --- Meshes ---

def pyramid(asset, source):
    """The values of a texel source at all its mip levels."""
    values = asset.accessor(source["accessor"]).reshape(source["height"], source["width"], -1)
    levels = [np.array(source.get("offset", [0])) + np.array(source.get("scale", [1])) * values]
    while len(levels) < 5 and all(side % 2 == 0 for side in levels[-1].shape[:2]):
        v = levels[-1]
        levels.append((v[::2, ::2] + v[1::2, ::2] + v[::2, 1::2] + v[1::2, 1::2]) / 4)
    return levels


def sample(levels, uv, uv_x, uv_y):
    """Trilinear samples at texture coordinates with these derivatives along pixels, [n, 2] each."""
    size = np.array(levels[0].shape[1::-1])
    (sx, tx), (sy, ty) = (uv_x * size).T, (uv_y * size).T
    a, b, c = sx**2 + tx**2, sy**2 + ty**2, sx * sy + tx * ty
    longest = (a + b) / 2 + np.sqrt((a - b) ** 2 / 4 + c**2)
    level = np.clip(0.5 * np.log2(np.maximum(longest, 1e-30)), 0, len(levels) - 1)
    result = 0
    for m, texels in enumerate(levels):
        h, w = texels.shape[:2]
        p = uv * [w, h] - 0.5
        i, f = np.floor(p).astype(int), p - np.floor(p)
        for di, dj in itertools.product((0, 1), (0, 1)):
            weight = (f[:, 0] if di else 1 - f[:, 0]) * (f[:, 1] if dj else 1 - f[:, 1])
            tap = texels[np.clip(i[:, 1] + dj, 0, h - 1), np.clip(i[:, 0] + di, 0, w - 1)]
            result = result + (weight * np.maximum(0, 1 - abs(level - m)))[:, None] * tap
    return result


def mesh_layers(asset, view, near, layers):
    """Depth [L, h, w] (infinite where there is none), opacity [L, h, w] and colour [L, h, w, 3] of the mesh layers."""
    depth = np.full((layers, view.h, view.w), np.inf)
    hit = np.full((layers, view.h, view.w), -1)
    corners, uvs, primitive_of, primitives = [], [], [], []
    for node, matrix in asset.nodes():
        for primitive in asset.json["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            if primitive.get("mode", 4) != 4:
                continue
            get = lambda name: asset.accessor(primitive["attributes"][name])
            index = asset.accessor(primitive["indices"]).astype(int).reshape(-1, 3)
            corners.append(view.to_camera(get("POSITION") @ matrix[:3, :3].T + matrix[:3, 3])[index])
            uvs.append(get("TEXCOORD_0")[index])
            primitive_of.append(np.full(len(index), len(primitives)))
            primitives.append((primitive, orthogonal(matrix)))
    if not primitives:
        return depth, np.zeros_like(depth), np.zeros((*depth.shape, 3))
    corners, uvs, primitive_of = (np.concatenate(x) for x in (corners, uvs, primitive_of))
    for number, v in enumerate(corners):
        if v[:, 2].max() <= near:
            continue
        i0, j0, i1, j1 = 0, 0, view.w, view.h
        if v[:, 2].min() > 0:
            u = view.fx * v[:, 0] / v[:, 2] + view.cx
            w = view.fy * v[:, 1] / v[:, 2] + view.cy
            i0, j0 = max(i0, int(max(u.min(), 0))), max(j0, int(max(w.min(), 0)))
            i1, j1 = min(i1, int(max(u.max(), 0)) + 1), min(j1, int(max(w.max(), 0)) + 1)
        if i0 >= i1 or j0 >= j1:
            continue
        n = np.cross(v[[1, 2, 0]], v[[2, 0, 1]])
        a = view.rays(*np.meshgrid(np.arange(i0, i1), np.arange(j0, j1))) @ n.T
        total = a.sum(-1)
        sign = np.sign(total)[..., None]
        inward = np.where(n[:, 0] != 0, n[:, 0], n[:, 1]) * sign  # top-left rule
        inside = ((a * sign > 0) | ((a == 0) & (inward > 0))).all(-1) & (total != 0)
        z = np.where(inside, v[0] @ n[0] / np.where(total == 0, 1, total), np.inf)
        z[z <= near] = np.inf
        who = np.full(z.shape, number)
        for l in range(layers):  # insert into the sorted layers; earlier triangles win ties
            d, k = depth[l, j0:j1, i0:i1], hit[l, j0:j1, i0:i1]
            closer = z < d
            z, d[...], who, k[...] = (np.where(closer, d, z), np.where(closer, z, d),
                                      np.where(closer, k, who), np.where(closer, who, k))
    opacity, color = np.zeros_like(depth), np.zeros((*depth.shape, 3))
    for number, (primitive, turn) in enumerate(primitives):
        where = np.nonzero((hit >= 0) & (primitive_of[hit] == number))
        triangle, ray = hit[where], view.rays(where[2], where[1])
        v = corners[triangle]
        n = np.cross(v[:, [1, 2, 0]], v[:, [2, 0, 1]])
        a = np.einsum("nkc,nc->nk", n, ray)
        total = a.sum(1, keepdims=True)
        bary = a / total
        on_uv = lambda b: np.einsum("nk,nkc->nc", b, uvs[triangle])
        along = [(n[..., axis] / f - bary * (n[..., axis] / f).sum(1, keepdims=True)) / total
                 for axis, f in [(0, view.fx), (1, view.fy)]]
        place = [on_uv(b) for b in (bary, *along)]
        d = ray @ view.rotation
        basis = sh_basis(d / np.linalg.norm(d, axis=1, keepdims=True) @ turn)
        radiance = asset.json["materials"][primitive["material"]]["extensions"][EXT]
        for k, source in enumerate(radiance["sphericalHarmonics"]["coefficients"]):
            color[where] += basis[:, k, None] * sample(pyramid(asset, source), *place)
        value = sample(pyramid(asset, radiance["opacity"]), *place)[:, 0]
        logistic = radiance["opacity"].get("activation", "none") == "logistic"
        opacity[where] = np.minimum(1 / (1 + np.exp(-value)) if logistic else np.clip(value, 0, 1), 0.9999)
    return depth, opacity, np.maximum(0, color + 0.5 * (hit >= 0)[..., None])


# --- Order ---

def surface_depth(depth, u, v, lam):
    """Depth of a layer at (u, v), None if empty there, or "outside"."""
    h, w = depth.shape
    if not (0 <= u < w and 0 <= v < h):
        return "outside"
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    f, g = u - 0.5 - x, v - 0.5 - y
    clamp = lambda i, n: min(max(i, 0), n - 1)
    taps = np.array([depth[clamp(y + dj, h), clamp(x + di, w)] for dj in (0, 1) for di in (0, 1)])
    weights = np.array([(1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g])
    valid = (weights > 0) & np.isfinite(taps)
    if not valid.any():
        return None
    if taps[valid].max() - taps[valid].min() > lam:
        best = taps[weights.argmax()]
        return best if np.isfinite(best) else None
    return weights[valid].sum() / (weights[valid] / taps[valid]).sum()


def thresholds(mode, z, surfaces, lam):
    beyond = lambda s: z > s * (1 + 1e-5)
    if mode == "direct":
        return [z] * len(surfaces)
    if mode == "stable":
        return [np.inf if s == "outside" else z if s is None else np.inf if beyond(s) else z - lam for s in surfaces]
    depths = [s for s in surfaces if s is not None and s != "outside"]
    b = max((s for s in depths if beyond(s)), default=None)
    a = min((s for s in depths if not beyond(s)), default=None)
    if a is None:
        h = z if b is None else max(z, b + lam)
    elif b is None:
        h = min(z, a - lam)
    else:
        lower = min(z, a - lam)
        h = lower if lower > (a + b) / 2 else min(max(z, b + lam), (a + b) / 2)
    return [h] * len(surfaces)


# --- Blending ---

def contract_of(asset):
    return asset.json["scenes"][asset.json.get("scene", 0)]["extensions"][EXT]


def render(asset):
    """The image [h, w, 3] in the scene's colour space."""
    contract = contract_of(asset)
    view = View(asset)
    near, layers, lam = contract.get("near", view.znear), contract.get("layers", 1), contract.get("lambda", np.inf)
    depth, opacity, layer_color = mesh_layers(asset, view, near, layers)
    splats = []
    for z, (u, v), conic, o, c, (rx, ry) in zip(*project_splats(asset, view, near, contract.get("footprint", {}))):
        i0, i1 = max(int(np.ceil(u - rx - 0.5)), 0), min(int(np.floor(u + rx - 0.5)) + 1, view.w)
        j0, j1 = max(int(np.ceil(v - ry - 0.5)), 0), min(int(np.floor(v + ry - 0.5)) + 1, view.h)
        if i0 >= i1 or j0 >= j1:
            continue
        dx, dy = np.arange(i0, i1) + 0.5 - u, (np.arange(j0, j1) + 0.5 - v)[:, None]
        alpha = np.minimum(0.99, o * np.exp(-0.5 * (conic[0, 0] * dx**2 + conic[1, 1] * dy**2) - conic[0, 1] * dx * dy))
        alpha[alpha < 1 / 255] = 0
        window = np.s_[j0:j1, i0:i1]
        surfaces = [surface_depth(d, u, v, lam) for d in depth]
        bucket = np.zeros(alpha.shape, int)
        for i, h in enumerate(thresholds(contract.get("mode", "stable"), z, surfaces, lam)):
            bucket[depth[i][window] < h] = i + 1
        splats.append((window, alpha, bucket, c))
    t, color = np.ones((view.h, view.w)), np.zeros((view.h, view.w, 3))
    for b in range(layers + 1):
        if b > 0:
            color += (t * opacity[b - 1])[..., None] * layer_color[b - 1]
            t = t * (1 - opacity[b - 1])
        closed = np.zeros(t.shape, bool)
        for window, alpha, bucket, c in splats:
            alpha = np.where((bucket == b) & ~closed[window], alpha, 0)
            closes = (alpha > 0) & (t[window] * (1 - alpha) < 1e-4)
            closed[window] |= closes
            alpha = np.where(closes, 0, alpha)
            color[window] += (t[window] * alpha)[..., None] * c
            t[window] *= 1 - alpha
    return color + t[..., None] * np.array(contract.get("background", [0, 0, 0]))
