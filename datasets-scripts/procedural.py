"""Procedural geometry and textures for the scenes of this folder: NumPy and Pillow only, no input files.

z is up. Textures are sRGB uint8 [H, W, 3], row 0 at v = 1.
A shape is a dict: positions [N, 3], normals [N, 3] or None, uvs [N, 2], triangles [M, 3], texture, gloss (0 = matt),
grows (whether it consists of blades and leaves, unlike a smooth surface).
"""

import numpy as np
from PIL import Image, ImageDraw


def shape(positions, uvs, triangles, texture, normals=None, gloss=0.0):
    return dict(
        positions=np.asarray(positions, np.float32),
        normals=None if normals is None else np.asarray(normals, np.float32),
        uvs=np.asarray(uvs, np.float32),
        triangles=np.asarray(triangles, np.int32),
        texture=texture,
        gloss=gloss,
        grows=False,
    )


def plant(blades, texture):
    """Makes a shape of the result of `strips`."""
    return {**shape(*blades, texture), "grows": True}


# ---------------------------------------------------------------- geometry


def merged(parts):
    """Merges several (positions, uvs, triangles) into one."""
    positions, uvs, triangles = zip(*parts)
    starts = np.cumsum([0] + [len(p) for p in positions])
    return np.concatenate(positions), np.concatenate(uvs), np.concatenate([t + s for t, s in zip(triangles, starts)])


def grid_triangles(rows, cols, offset=0):
    """Two triangles per cell of a [rows, cols] vertex grid."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(cols - 1), indexing="ij")
    a = (r * cols + c).ravel() + offset
    return np.concatenate([np.stack([a, a + 1, a + cols + 1], 1), np.stack([a, a + cols + 1, a + cols], 1)])


def revolve(profile, centre, segments=128):
    """Surface of revolution about z of a profile [P, 2] of (radius, height); v runs along the profile's arc length."""
    profile = np.asarray(profile, float)
    step = np.gradient(profile, axis=0)
    normal = np.stack([step[:, 1], -step[:, 0]], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))]
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)

    def sweep(rz):
        radial = rz[:, None, :1] * ring[None]
        return np.concatenate([radial, np.repeat(rz[:, None, 1:], segments + 1, 1)], 2).reshape(-1, 3)

    u, v = np.meshgrid(angle / (2 * np.pi), length / length[-1])
    uvs = np.stack([u.ravel(), v.ravel()], 1)
    return sweep(profile) + centre, uvs, grid_triangles(len(profile), segments + 1), sweep(normal)


def smooth_profile(knots, samples=96):
    """Catmull-Rom curve through the knots."""
    k = np.asarray(knots, float)
    k = np.vstack([2 * k[0] - k[1], k, 2 * k[-1] - k[-2]])
    t = np.linspace(0, len(knots) - 1 - 1e-9, samples)
    i, f = t.astype(int), (t % 1)[:, None]
    a, b, c, d = k[i], k[i + 1], k[i + 2], k[i + 3]
    return 0.5 * (2 * b + (c - a) * f + (2 * a - 5 * b + 4 * c - d) * f**2 + (3 * b - a - 3 * c + d) * f**3)


def sphere(centre, radius, segments=96):
    t = np.linspace(0, np.pi, segments // 2 + 1)
    return revolve(np.stack([radius * np.sin(t), -radius * np.cos(t)], 1), centre, segments)


def strips(roots, directions, lengths, widths, droop, outline, rng, segments=8, curl=0.0):
    """Thin curved blades: each starts at its root, leaves along its direction and bends down by `droop`.

    `outline(s)` is the width profile over the blade. u is random per blade (its shade), v runs from root to tip.
    """
    n, s = len(roots), np.linspace(0, 1, segments + 1)
    points = np.empty((n, segments + 1, 3))
    points[:, 0] = roots
    heading = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    side = np.cross(heading, rng.normal(size=(n, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    for i in range(segments):
        points[:, i + 1] = points[:, i] + heading * (lengths / segments)[:, None]
        heading = heading + np.array([0, 0, -1]) * (droop / segments)[:, None] + side * curl / segments
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    points[..., 2] = np.maximum(points[..., 2], 0.004)  # blades that would pass through the table lie on it
    half = 0.5 * widths[:, None, None] * outline(s)[None, :, None]
    pair = np.stack([points - side[:, None] * half, points + side[:, None] * half], 2)
    shade = rng.uniform(0.02, 0.98, n)
    uvs = np.stack([np.broadcast_to(shade[:, None, None], (n, segments + 1, 2)),
                    np.broadcast_to(s[None, :, None], (n, segments + 1, 2))], -1)
    block = 2 * (segments + 1)
    one = grid_triangles(segments + 1, 2)
    triangles = (one[None] + block * np.arange(n)[:, None, None]).reshape(-1, 3)
    return pair.reshape(-1, 3), uvs.reshape(-1, 2), triangles


def directions_on_sphere(n, rng):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def upward(n, spread, rng):
    """Random directions around +z, tilted by up to `spread` radians, denser near the axis."""
    tilt, turn = spread * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], 1)


# ---------------------------------------------------------------- textures


def waves(points, rng, count=48, low=2.0, high=14.0):
    """Smooth 3D noise: a sum of plane waves with amplitudes that decrease with frequency; about unit variance."""
    field = np.zeros(points.shape[:-1])
    for _ in range(count):
        frequency = np.exp(rng.uniform(np.log(low), np.log(high)))
        wave = directions_on_sphere(1, rng)[0] * frequency
        field += (low / frequency) ** 0.8 * np.cos(points @ wave + rng.uniform(0, 2 * np.pi))
    return field / field.std()


def layers(base, *painted):
    """Paints (mask, colour) pairs over a base colour; returns float [H, W, 3]."""
    image = np.broadcast_to(np.array(base, float), painted[0][0].shape + (3,)).copy()
    for mask, colour in painted:
        image[mask] = colour
    return image


def as_texture(image):
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def gradient(root, tip, rng, shades=64, spread=26):
    """Blade colours: one column per shade, root at v = 0 (last row)."""
    s = np.linspace(1, 0, 32)[:, None, None]
    colour = np.array(root) * (1 - s) + np.array(tip) * s
    return as_texture(colour + rng.normal(size=(1, shades, 1)) * spread + rng.normal(size=(1, shades, 3)) * spread / 3)


def glyph_band(width, height, count, rng, ink, paper):
    """A line of invented letters: random strokes on a 3 x 4 lattice."""
    image = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(image)
    cell = width / count
    for i in range(count):
        at = lambda p: (cell * (i + 0.2 + 0.3 * p[0]), height * (0.14 + 0.24 * p[1]))
        here = (rng.integers(3), rng.integers(4))
        for _ in range(6):
            there = (rng.integers(3), (here[1] + rng.integers(1, 4)) % 4)
            draw.line([at(here), at(there)], fill=ink, width=int(cell * 0.13))
            here = there
    return np.asarray(image, float)


def flat(colour):
    return np.full((2, 2, 3), colour, np.uint8)


# ---------------------------------------------------------------- outlines of blades


def blade(s):
    return np.sqrt(np.clip(1 - s, 0, 1)) * (0.7 + 0.6 * s * (1 - s))


def leaf(s):
    return 0.06 + np.sin(np.pi * s) ** 0.8 * (1 - 0.3 * s)
