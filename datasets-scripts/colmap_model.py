"""Pinhole cameras, and COLMAP's binary models of them: NumPy only.

A pose is (rotation [3, 3], translation [3]) from world to camera, axes as in COLMAP: x right, y down, z forward.
Pixel coordinates count from the corner of the picture: the first pixel's centre is (0.5, 0.5).
"""

import struct
from dataclasses import dataclass

import numpy as np

PINHOLE = 1
NO_POINT = 2**64 - 1
IMAGE, POINT = struct.Struct("<i7di"), struct.Struct("<Q3d3BdQ")
OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera for all views; focal length and principal point in pixels."""

    width: int
    height: int
    focal: float
    principal: tuple

    def intrinsics(self):
        return np.array([[self.focal, 0, self.principal[0]], [0, self.focal, self.principal[1]], [0, 0, 1]])

    def project(self, pose, point):
        """Pixel coordinates; None outside the picture or in its outermost pixels."""
        x, y, z = self.intrinsics() @ (pose[0] @ point + pose[1])
        if z <= 0:
            return None
        u, v = x / z, y / z
        return (u, v) if 1 <= u < self.width - 1 and 1 <= v < self.height - 1 else None

    def ray(self, pose, pixel):
        """Unit direction in world space through pixel coordinates."""
        direction = pose[0].T @ np.linalg.solve(self.intrinsics(), [pixel[0], pixel[1], 1.0])
        return direction / np.linalg.norm(direction)


def facing(eye, back):
    """Pose of a level camera at `eye`; `back` is the unit vector away from the point it looks at, and z is up."""
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(right, back), -back])
    return rotation, -rotation @ eye


def centre_of(pose):
    return -pose[0].T @ pose[1]


def quaternion(r):
    """wxyz of a rotation matrix, w >= 0."""
    w, v = np.linalg.eigh(np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ]))
    q = v[:, np.argmax(w)]
    return q if q[0] >= 0 else -q


def rotation_of(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def name_of(index):
    return f"{index:03d}.jpg"


def write_model(folder, camera, poses, positions, colours, observations=None, errors=None):
    """Writes a model with one shared PINHOLE camera; view i is the picture name_of(i).

    `observations` contains for each view a list of (x, y, point index, or None for a feature without a point), which
    define the points' tracks; without it, observations and tracks are empty. `errors` are the points' mean distances
    from their observations in pixels.
    """
    folder.mkdir(parents=True, exist_ok=True)
    observations = observations or [[]] * len(poses)
    errors = np.zeros(len(positions)) if errors is None else errors
    tracks = [[] for _ in positions]
    lens = (camera.focal, camera.focal, *camera.principal)
    images = struct.pack("<Q", len(poses))
    for i, ((rotation, translation), seen) in enumerate(zip(poses, observations)):
        for k, (_, _, point) in enumerate(seen):
            if point is not None:
                tracks[point].append((i + 1, k))
        images += IMAGE.pack(i + 1, *quaternion(rotation), *translation, 1) + name_of(i).encode() + b"\0" + struct.pack("<Q", len(seen))
        rows = [(x, y, NO_POINT if point is None else point + 1) for x, y, point in seen]
        images += np.array(rows, OBSERVATION).tobytes()
    points = struct.pack("<Q", len(positions))
    for i, (xyz, rgb, error, track) in enumerate(zip(positions, colours, errors, tracks)):
        points += POINT.pack(i + 1, *xyz, *map(int, rgb), error, len(track)) + np.array(track, "<i4").tobytes()
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, PINHOLE, camera.width, camera.height, *lens))
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(points)


def read_model(folder):
    """Reads a model written by write_model: poses, positions, colours, observations per view as they were given, and
    tracks of (view, index among its observations)."""
    data, poses, observations, at = (folder / "images.bin").read_bytes(), [], [], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = IMAGE.unpack_from(data, at)
        at = data.index(b"\0", at + IMAGE.size) + 9
        poses.append((rotation_of(values[1:5]), np.array(values[5:8])))
        rows = np.frombuffer(data, OBSERVATION, struct.unpack_from("<Q", data, at - 8)[0], at)
        observations.append([(x, y, None if point == NO_POINT else int(point) - 1) for x, y, point in rows.tolist()])
        at += rows.nbytes
    data, at, rows, tracks = (folder / "points3D.bin").read_bytes(), 8, [], []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        rows.append(POINT.unpack_from(data, at))
        track = np.frombuffer(data, "<i4", 2 * rows[-1][-1], at + POINT.size)
        tracks.append([(image - 1, k) for image, k in track.reshape(-1, 2).tolist()])
        at += POINT.size + track.nbytes
    return poses, np.array([r[1:4] for r in rows]), np.array([r[4:7] for r in rows]), observations, tracks
