"""Building blocks of unbounded scenes: noise, ground, boxes and tubes, plants. Lengths in metres, z is up."""

import numpy as np

from colmap_model import Camera, facing
from procedural import as_texture, blade, directions_on_sphere, gradient, grid_triangles, leaf, merged, plant, revolve, shape, strips

CAMERA = Camera(256, 160, 210.0, (128.0, 80.0))
VIEWS = 40


def look(eye, target):
    back = np.subtract(eye, target).astype(float)
    return facing(np.asarray(eye, float), back / np.linalg.norm(back))


# ---------------------------------------------------------------- noise


def tile_noise(rng, size=512, falloff=1.0):
    """Periodic noise [size, size] of unit variance whose amplitude falls with frequency ** falloff."""
    spectrum = np.fft.rfft2(rng.normal(size=(size, size)))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(spectrum / frequency**falloff, s=(size, size))
    return noise / noise.std()


def at(noise, x, y, period):
    """Periodic noise that repeats every `period`, bilinear."""
    n = len(noise)
    u, v = (x / period) % 1 * n, (y / period) % 1 * n
    i, j = u.astype(int) % n, v.astype(int) % n
    fu, fv = u - np.floor(u), v - np.floor(v)
    k, m = (i + 1) % n, (j + 1) % n
    return (noise[j, i] * (1 - fu) + noise[j, k] * fu) * (1 - fv) + (noise[m, i] * (1 - fu) + noise[m, k] * fu) * fv


def mixed(a, b, t):
    """Colours between a and b by t [...], clipped to 0..1."""
    t = np.clip(t, 0, 1)[..., None]
    return np.asarray(a, float) * (1 - t) + np.asarray(b, float) * t


# ---------------------------------------------------------------- flat things


def quad(corners, texture, repeat=(1, 1)):
    """A quadrilateral [4, 3] anticlockwise from the texture's lower left."""
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * repeat
    return shape(corners, uvs, [[0, 1, 2], [0, 2, 3]], texture)


def joined(parts, texture):
    """Joins several (positions, uvs, triangles) into one shape."""
    return shape(*merged(parts), texture)


def box_part(centre, size, turn=0.0):
    """Sides and lid of a box; every face has the whole texture. `centre` is the centre of its bottom."""
    x, y, z = np.asarray(size, float) / [2, 2, 1]
    corner = {(i, j, k): (i * x, j * y, k * z) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)}
    rings = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    faces = [[(*rings[i], 0), (*rings[(i + 1) % 4], 0), (*rings[(i + 1) % 4], 1), (*rings[i], 1)] for i in range(4)]
    faces += [[(*r, 1) for r in rings], [(*r, 0) for r in rings[::-1]]]
    positions = np.array([corner[c] for face in faces for c in face])
    c, s = np.cos(turn), np.sin(turn)
    uvs = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (6, 1))
    triangles = np.concatenate([[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(6)])
    return positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + centre, uvs, triangles


def tube_part(points, radii, segments=6):
    """A tube along points [N, 3]; u around, v along."""
    points, radii = np.asarray(points, float), np.broadcast_to(radii, len(points))
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    pole = np.where(np.abs(along[:, 2:]) < 0.9, [[0, 0, 1.0]], [[1.0, 0, 0]])
    side = np.cross(along, pole)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = side[:, None] * np.cos(angle)[None, :, None] + other[:, None] * np.sin(angle)[None, :, None]
    positions = points[:, None] + ring * radii[:, None, None]
    u, v = np.meshgrid(np.linspace(0, 1, segments + 1), np.linspace(0, 1, len(points)))
    return positions.reshape(-1, 3), np.stack([u.ravel(), v.ravel()], 1), grid_triangles(len(points), segments + 1)


def square_ring(inner, outer, texture, cells=16):
    """The ground between two squares with these half sides around the origin, in z = 0; the texture spans the outer
    one."""
    line = np.linspace(-outer, outer, cells + 1)
    line = np.unique(np.r_[line[np.abs(line) > inner + 1e-9], -inner, inner]) if inner else line
    x, y = np.meshgrid(line, line)
    positions = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    triangles = grid_triangles(len(line), len(line))
    middle = np.abs(positions[triangles].mean(1)[:, :2]).max(1)
    return shape(positions, positions[:, :2] / (2 * outer) + 0.5, triangles[middle > inner], texture)


def over_square(colour, half, size):
    """The texture of square_ring: colour(x, y) -> [..., 3] at the centres of size x size texels."""
    line = ((np.arange(size) + 0.5) / size * 2 - 1) * half
    x, y = np.meshgrid(line, -line)
    return as_texture(colour(x, y))


def revolved(profile, centre, texture, gloss=0.0, segments=64):
    positions, uvs, triangles, normals = revolve(profile, np.asarray(centre, float), segments)
    return shape(positions, uvs, triangles, texture, normals, gloss)


# ---------------------------------------------------------------- plants


def bark(rng):
    noise = tile_noise(rng, 128)
    stripes = np.roll(noise, 5, 0) * 0.4 + noise[:1].repeat(128, 0)
    return as_texture(np.array((96, 76, 58), float) * (1 + 0.25 * stripes)[..., None])


def tree(base, height, rng, leaves=3000, leaf_size=0.22, dark=(28, 58, 20), light=(118, 150, 58), crown=0.33):
    """Trunk and branches as tubes; leaves in blobs about the ends of the branches."""
    base = np.asarray(base, float)
    sway = rng.normal(size=2) * 0.05 * height
    s = np.linspace(0, 1, 9)[:, None]
    trunk = base + np.hstack([s**2 * sway, s * height * 0.72])
    parts, ends = [tube_part(trunk, 0.035 * height * (1 - 0.75 * s[:, 0]), 8)], []
    for i in range(11):
        t = rng.uniform(0.42, 0.98)
        start = base + np.r_[t**2 * sway, t * height * 0.72]
        turn, tilt = 2.4 * i + rng.uniform(-0.4, 0.4), rng.uniform(0.3, 1.0) * (1.25 - t * 0.6)
        length = height * crown * rng.uniform(0.65, 1.05)
        heading = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        branch = start + s * length * heading + s**2 * [0, 0, 0.15 * length]
        parts.append(tube_part(branch, 0.014 * height * (1 - 0.85 * s[:, 0]) * (1.3 - t), 5))
        ends.append(branch[-2])
    ends.append(trunk[-1] + [0, 0, 0.1 * height])
    shapes = [joined(parts, bark(rng))]
    blob = rng.integers(len(ends), size=leaves)
    out = directions_on_sphere(leaves, rng)
    radius = height * 0.17 * rng.uniform(0.35, 1.0, leaves) ** 0.5 * rng.uniform(0.8, 1.2, len(ends))[blob]
    roots = np.array(ends)[blob] + out * radius[:, None] * [1, 1, 0.8]
    heading = out + 0.9 * rng.normal(size=out.shape) + [0, 0, -0.3]
    size = leaf_size * rng.uniform(0.7, 1.3, leaves)
    blades = strips(roots, heading, size, size * 0.62, np.full(leaves, 0.5), leaf, rng, 3)
    shapes.append(plant(blades, gradient(dark, light, rng)))
    return shapes


def grass(centre, radius, count, height, width, rng, root=(40, 64, 24), tip=(150, 178, 78)):
    r, t = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    roots = np.asarray(centre, float) + np.stack([r * np.cos(t), r * np.sin(t), 0 * r], 1)
    heading = rng.normal(size=(count, 3)) * 0.35 + [0, 0, 1]
    return plant(
        strips(
            roots,
            heading,
            height * rng.uniform(0.5, 1.1, count),
            width * rng.uniform(0.7, 1.3, count),
            rng.uniform(0.2, 1.6, count),
            blade,
            rng,
            4,
        ),
        gradient(root, tip, rng)
    )


def bush(centre, size, rng, count=2500, leaf_size=0.1, dark=(30, 62, 34), light=(110, 156, 84)):
    """Leaves through an ellipsoid, denser towards its outside, and a few stems."""
    out = directions_on_sphere(count, rng)
    out[:, 2] = np.abs(out[:, 2])
    radius = rng.uniform(0.2, 1.0, count) ** 0.4
    bumps = 1 + 0.18 * np.sin(5 * out[:, 0] + 1) * np.cos(6 * out[:, 1]) + 0.1 * np.sin(9 * out[:, 2])
    roots = np.asarray(centre, float) + out * (radius * bumps)[:, None] * size + [0, 0, 0.06]
    length = leaf_size * rng.uniform(0.7, 1.3, count)
    heading = out + 0.8 * rng.normal(size=out.shape)
    return plant(strips(roots, heading, length, length * 0.6, np.full(count, 0.6), leaf, rng, 3), gradient(dark, light, rng))
