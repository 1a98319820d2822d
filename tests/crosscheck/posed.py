"""Poses a glTF file at a point in time, in numpy: animations, morph targets, skins and bindings of splats, written from
the specifications of glTF 2.0 (3.7.2.2 morph targets, 3.7.3 skins, 3.11 and appendix C animations) and of the extension
(Binding)."""
import numpy as np

from composition import EXT, KHR, Asset, rotations


class Posed(Asset):
    """A posed asset. Posed geometry is in global space: its node gets the identity transform."""

    def __init__(self, path, time):
        super().__init__(path)
        self.new, self.placed, self.weights = [], set(), {}
        for animation in self.json.get("animations", []):
            for channel in animation["channels"]:
                node, key = channel["target"]["node"], channel["target"]["path"]
                value = sampled(self, animation["samplers"][channel["sampler"]], time, key)
                if key == "weights":
                    self.weights[node] = value
                else:
                    self.json["nodes"][node][key] = list(value)
        number = {id(node): i for i, node in enumerate(self.json["nodes"])}
        self.globals = {number[id(node)]: matrix for node, matrix in super().nodes()}
        for index, node in enumerate(self.json["nodes"]):
            for primitive in self.json["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
                if KHR not in primitive.get("extensions", {}):
                    self.pose_surface(index, node, primitive)
        for index, node in enumerate(self.json["nodes"]):
            for primitive in self.json["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
                own = primitive.get("extensions", {}).get(KHR, {}).get("extensions", {}).get(EXT, {})
                if "binding" in own:
                    self.pose_splats(index, primitive, own["binding"])

    def accessor(self, index):
        return index[0] if isinstance(index, tuple) else super().accessor(index)

    def nodes(self):
        number = {id(node): i for i, node in enumerate(self.json["nodes"])}
        for node, matrix in super().nodes():
            yield node, np.eye(4) if number[id(node)] in self.placed else matrix

    def pose_surface(self, index, node, primitive):
        mesh, attributes = self.json["meshes"][node["mesh"]], primitive["attributes"]
        primitive["undeformed"] = p = self.accessor(attributes["POSITION"])
        weights = self.weights.get(index, node.get("weights", mesh.get("weights", [])))
        for weight, target in zip(weights, primitive.get("targets", [])):
            p = p + weight * self.accessor(target["POSITION"])
        matrix = self.globals[index]
        if "skin" in node:
            skin = self.json["skins"][node["skin"]]
            inverse = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
            joints = np.stack([self.globals[joint] for joint in skin["joints"]]) @ inverse
            which, weight = self.accessor(attributes["JOINTS_0"]).astype(int), self.accessor(attributes["WEIGHTS_0"])
            matrix = np.einsum("vj,vjab->vab", weight / weight.sum(1, keepdims=True), joints[which])
        attributes["POSITION"] = (np.einsum("...ab,...b->...a", matrix[..., :3, :3], p) + matrix[..., :3, 3],)
        self.placed.add(index)

    def pose_splats(self, index, primitive, binding):
        surface = self.json["meshes"][self.json["nodes"][binding["node"]]["mesh"]]["primitives"][binding.get("primitive", 0)]
        corners = self.accessor(surface["indices"]).astype(int).reshape(-1, 3)[self.accessor(binding["triangles"]).astype(int)]
        axes, size, center = frames(self.accessor(surface["attributes"]["POSITION"])[corners])
        attributes = primitive["attributes"]
        local = self.accessor(binding["translations"])
        attributes["POSITION"] = (size[:, None] * np.einsum("nij,nj->ni", axes, local) + center,)
        attributes[f"{KHR}:SCALE"] = (size[:, None] * self.accessor(binding["scales"]),)
        attributes[f"{KHR}:ROTATION"] = (quaternions(axes @ rotations(self.accessor(binding["rotations"]))),)
        if binding.get("sphericalHarmonicsFrame", "node") == "triangle":
            undeformed, _, _ = frames(surface["undeformed"][corners])
            primitive["turn"] = axes @ undeformed.transpose(0, 2, 1)
        else:
            primitive["turn"] = self.globals[index][:3, :3] / np.cbrt(np.linalg.det(self.globals[index][:3, :3]))
        self.placed.add(index)


def sampled(asset, sampler, time, key):
    """Value of a channel: [3], [4] or weights."""
    times, values = asset.accessor(sampler["input"]), asset.accessor(sampler["output"])
    kind = sampler.get("interpolation", "LINEAR")
    values = values.reshape(len(times), 3 if kind == "CUBICSPLINE" else 1, -1)
    middle = values[:, 1 if kind == "CUBICSPLINE" else 0]
    k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1 or time <= times[0]:
        return middle[0]
    if time >= times[-1]:
        return middle[-1]
    td = times[k + 1] - times[k]
    t = (time - times[k]) / td
    a, b = middle[k], middle[k + 1]
    if kind == "STEP":
        return a
    if kind == "CUBICSPLINE":
        out, into = values[k, 2], values[k + 1, 0]
        v = ((2 * t**3 - 3 * t**2 + 1) * a + td * (t**3 - 2 * t**2 + t) * out
             + (-2 * t**3 + 3 * t**2) * b + td * (t**3 - t**2) * into)
        return v / np.linalg.norm(v) if key == "rotation" else v
    if key == "rotation":
        cosine = a @ b
        angle, sign = np.arccos(np.clip(abs(cosine), -1, 1)), -1 if cosine < 0 else 1
        if angle > 1e-9:
            return (np.sin(angle * (1 - t)) * a + sign * np.sin(angle * t) * b) / np.sin(angle)
    return (1 - t) * a + t * b


def frames(v):
    """Axes [N, 3, 3], sizes [N] and centres [N, 3] of triangles [N, 3, 3]."""
    unit = lambda x: x / np.linalg.norm(x, axis=1, keepdims=True)
    e, u = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
    a0 = unit(e)
    a1 = unit(np.cross(a0, u))
    a2 = np.cross(a0, a1)
    return np.stack([a0, a1, a2], -1), (np.linalg.norm(e, axis=1) + np.abs((a2 * u).sum(1))) / 2, v.mean(1)


def quaternions(m):
    """(x, y, z, w) of rotations: the eigenvector of Bar-Itzhack's matrix."""
    k = np.zeros((len(m), 4, 4))
    for row, column in np.ndindex(3, 3):
        k[:, row, column] = m[:, row, column] + m[:, column, row]
    trace = np.trace(m, axis1=1, axis2=2)
    k[:, range(3), range(3)] -= trace[:, None]
    k[:, :3, 3] = k[:, 3, :3] = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    k[:, 3, 3] = trace
    return np.linalg.eigh(k)[1][:, :, -1]
