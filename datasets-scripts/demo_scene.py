"""The demo scene: NumPy and Pillow only, every number from one seed.

A painted vase with ornamental grass and flowers, a glazed globe, a fur ball and a tuft of grass on a round tiled table.
Units: the table has radius 1 and lies in z = 0; z is up. Shapes and textures are those of procedural.py.
"""

import numpy as np

from procedural import (as_texture, blade, directions_on_sphere, flat, glyph_band, gradient, layers, leaf, plant, revolve, shape,
                        smooth_profile, sphere, strips, upward, waves)

CREAM, COBALT, NAVY = (244, 236, 216), (34, 72, 160), (18, 30, 74)
TERRACOTTA, TEAL, OCHRE, RUST = (178, 84, 52), (30, 104, 104), (222, 170, 70), (140, 48, 36)
GOLD = (206, 160, 74)


# ---------------------------------------------------------------- textures


def vase_texture(rng, width=3072, height=1536):
    """Bands from foot to rim: petals, checks, islands between wave lines, letters, zigzag, gold."""
    v, u = np.meshgrid(1 - (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    angle = 2 * np.pi * u
    around = np.stack([np.cos(angle), np.sin(angle), 2.6 * v], -1)
    image = np.zeros((height, width, 3))

    def band(low, high):
        rows = (v[:, 0] >= low) & (v[:, 0] < high)
        return rows, u[rows], (v[rows] - low) / (high - low)

    rows, bu, bv = band(0.0, 0.16)
    petal = np.abs((bu * 22) % 1 - 0.5) * 2
    leaf = petal < np.sqrt(np.clip(1 - bv**2, 0, 1)) * 0.92
    image[rows] = layers(COBALT, (leaf, CREAM), (leaf & (petal < 0.55 * (1 - bv)), TERRACOTTA), (petal < 0.08, NAVY))

    rows, bu, bv = band(0.16, 0.22)
    check = (np.floor(bu * 88) + np.floor(bv * 3)) % 2 == 0
    image[rows] = layers(CREAM, (check, NAVY))

    rows, bu, bv = band(0.22, 0.62)
    field = waves(around[rows], rng, 64, 5, 24) + 0.5 * np.sin(np.pi * bv) - 0.35
    ripple = (field * 2.6) % 1 < 0.36
    inland = (field * 3) % 1 < 0.4
    image[rows] = layers(CREAM, ((field < 0.1) & ripple, (92, 136, 204)), (field > 0.12, COBALT), (field > 0.2, OCHRE),
                         ((field > 0.2) & inland, TERRACOTTA), (field > 1.1, TEAL), ((field > 1.1) & inland, CREAM))

    rows, bu, bv = band(0.62, 0.74)
    image[rows] = glyph_band(width, int(rows.sum()), 30, rng, NAVY, (238, 214, 170))
    edge = (bv < 0.1) | (bv > 0.9)
    image[rows] = np.where(edge[..., None], RUST, image[rows])

    rows, bu, bv = band(0.74, 0.88)
    zigzag = (bv * 4 + np.abs((bu * 30) % 1 - 0.5) * 2) % 1
    image[rows] = layers(COBALT, (zigzag < 0.55, CREAM), (zigzag < 0.2, TERRACOTTA))

    rows, bu, bv = band(0.88, 1.01)
    image[rows] = GOLD
    return as_texture(image * (1 + 0.02 * rng.normal(size=(height, width, 1))))


def globe_texture(rng, width=1536, height=768):
    """Islands with contour lines in a sea with a graticule."""
    latitude, longitude = np.meshgrid(np.pi / 2 - np.pi * (np.arange(height) + 0.5) / height,
                                      2 * np.pi * (np.arange(width) + 0.5) / width, indexing="ij")
    on_sphere = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)
    field = waves(on_sphere, rng, 64, 3, 16)
    degrees = np.degrees(latitude), np.degrees(longitude)
    lines = (degrees[0] % 15 < 1.6) | (degrees[1] % 15 < 1.6 / np.maximum(np.cos(latitude), 0.2))
    contour = (field * 4) % 1 < 0.28
    return as_texture(layers((38, 110, 130), (lines, (190, 214, 204)), (field > 0.25, (232, 214, 160)), (field > 0.36, (84, 132, 62)),
                             ((field > 0.36) & contour, (40, 74, 40)), (field > 1.3, (150, 96, 60)), (field > 1.9, (246, 244, 238))))


def tile_texture(rng, size=2048, tiles=11):
    """Cement tiles with grout; four motifs placed at random, each tile a little lighter or darker."""
    y, x = np.meshgrid(1 - (np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    ix, iy = (x * tiles).astype(int), (y * tiles).astype(int)
    a, b = (x * tiles) % 1 - 0.5, (y * tiles) % 1 - 0.5
    turn = rng.integers(0, 4, (tiles, tiles))[iy, ix]
    a, b = np.where(turn % 2, b, a), np.where(turn % 2, -a, b)
    r = np.hypot(a, b)
    corner = np.minimum(np.hypot(a - 0.5, b - 0.5), np.hypot(a + 0.5, b + 0.5))
    star = r * (1 + 0.45 * np.cos(8 * np.arctan2(b, a)))
    motifs = [
        layers(CREAM, (np.abs(corner - 0.5) < 0.17, TEAL), (np.abs(corner - 0.5) < 0.06, OCHRE)),
        layers(TERRACOTTA, (star < 0.36, CREAM), (r < 0.14, NAVY), (np.abs(r - 0.45) < 0.03, CREAM)),
        layers(TEAL, (np.abs(a) + np.abs(b) < 0.46, CREAM), (np.abs(a) + np.abs(b) < 0.33, RUST), (r < 0.1, CREAM)),
        layers(CREAM, ((np.floor(a * 6) + np.floor(b * 6)) % 2 == 0, (92, 84, 92))),
    ]
    kind = rng.integers(0, len(motifs), (tiles, tiles))[iy, ix]
    image = np.select([kind[..., None] == k for k in range(len(motifs))], motifs)
    image *= (1 + 0.07 * rng.normal(size=(tiles, tiles)))[iy, ix][..., None]
    grout = np.maximum(np.abs(a), np.abs(b)) > 0.475
    image[grout] = (196, 188, 176)
    rim = np.hypot(x - 0.5, y - 0.5) > 0.475
    image[rim] = (92, 58, 36)
    return as_texture(image * (1 + 0.03 * rng.normal(size=(size, size, 1))))


# ---------------------------------------------------------------- the scene

VASE = np.array([-0.08, 0.1, 0.0])
VASE_OUTSIDE = [(0.22, 0.0), (0.25, 0.03), (0.34, 0.16), (0.43, 0.36), (0.44, 0.5), (0.36, 0.68), (0.26, 0.8), (0.24, 0.88), (0.29, 0.95)]
VASE_INSIDE = [(0.29, 0.95), (0.275, 0.96), (0.25, 0.94), (0.22, 0.88)]


def build(seed=20):
    """All shapes of the scene."""
    rng = np.random.default_rng(seed)
    shapes = []

    def revolved(profile, centre, texture, gloss=0.0):
        positions, uvs, triangles, normals = revolve(profile, centre)
        shapes.append(shape(positions, uvs, triangles, texture, normals, gloss))

    def ball(centre, radius, texture, gloss=0.0, segments=96):
        positions, uvs, triangles, normals = sphere(np.asarray(centre, float), radius, segments)
        shapes.append(shape(positions, uvs, triangles, texture, normals, gloss))

    # Table: top disc with planar UVs, then its edge.
    angle = np.linspace(0, 2 * np.pi, 193)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    top = np.vstack([[0, 0, 0], rim])
    fan = np.stack([np.zeros(192, int), np.arange(1, 193), np.arange(1, 193) % 192 + 1], 1)
    shapes.append(shape(top, top[:, :2] / 2 + 0.5, fan, tile_texture(rng), np.tile([0, 0, 1.0], (193, 1))))
    revolved([(1.0, -0.08), (1.0, -0.04), (1.0, 0.0)], np.zeros(3), flat((84, 52, 32)))

    revolved(smooth_profile(VASE_OUTSIDE), VASE, vase_texture(rng), gloss=1.0)
    revolved(smooth_profile(VASE_INSIDE, 16), VASE, flat(GOLD), gloss=1.0)
    revolved([(0.235, 0.9), (0.12, 0.91), (0.001, 0.91)], VASE, flat((44, 30, 20)))
    ball((0.6, -0.34, 0.215), 0.215, globe_texture(rng), gloss=1.0)

    # Grass out of the vase.
    def planted(count, centre, radius):
        r, t = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
        offset = np.stack([r * np.cos(t), r * np.sin(t), 0 * r], 1)
        return np.asarray(centre) + offset, offset / radius

    root, out = planted(900, VASE + [0, 0, 0.9], 0.18)
    heading = upward(900, 0.35, rng) + 0.55 * out
    shapes.append(plant(strips(root, heading, rng.uniform(0.3, 0.62, 900), rng.uniform(0.008, 0.016, 900),
                                rng.uniform(0.3, 2.2, 900), blade, rng), gradient((38, 66, 22), (158, 196, 84), rng)))
    # Broad leaves over the rim.
    root, out = planted(26, VASE + [0, 0, 0.9], 0.19)
    heading = out / np.linalg.norm(out, axis=1, keepdims=True) + [0, 0, 0.9]
    shapes.append(plant(strips(root, heading, rng.uniform(0.3, 0.45, 26), rng.uniform(0.07, 0.1, 26),
                                rng.uniform(1.2, 2.6, 26), leaf, rng, 12), gradient((30, 84, 54), (96, 150, 90), rng)))
    # Flowers: a stem each and a head of thin petals.
    root, out = planted(24, VASE + [0, 0, 0.9], 0.15)
    heading = upward(24, 0.3, rng) + 0.5 * out
    positions, uvs, triangles = strips(root, heading, rng.uniform(0.4, 0.62, 24), np.full(24, 0.008), np.full(24, 0.5),
                                       lambda s: np.ones_like(s), rng, 10)
    shapes.append(plant((positions, uvs, triangles), gradient((50, 80, 30), (96, 120, 50), rng)))
    heads = positions.reshape(24, 11, 2, 3)[:, -1].mean(1)
    colours = [((222, 92, 120), (252, 214, 214)), ((240, 170, 40), (252, 226, 130)), ((110, 90, 190), (206, 196, 246))]
    for i, (inner, outer) in enumerate(colours):
        mine = heads[i::3]
        petals = np.repeat(mine, 60, 0)
        n = len(petals)
        shapes.append(plant(strips(petals, directions_on_sphere(n, rng) + [0, 0, 0.3], rng.uniform(0.03, 0.055, n), np.full(n, 0.013),
                                    np.full(n, 0.4), leaf, rng, 3), gradient(inner, outer, rng, spread=8)))

    # Fur ball.
    centre, radius, hairs = np.array([-0.52, -0.56, 0.21]), 0.14, 7000
    ball(centre, radius, flat((60, 36, 22)), segments=48)
    d = directions_on_sphere(hairs, rng)
    clump = waves(d[None] * 1.0, rng, 24, 5, 12)[0]
    swirl = np.cross(d, [0.3, 0.5, 0.8])
    heading = d + 0.5 * swirl + 0.18 * rng.normal(size=d.shape)
    shapes.append(plant(strips(centre + d * radius, heading, 0.075 + 0.012 * np.clip(clump, -2, 1.2),
                                rng.uniform(0.0035, 0.006, hairs), np.full(hairs, 0.5), blade, rng, 6, curl=0.5),
                        gradient((92, 50, 24), (250, 196, 120), rng, spread=20)))

    # A tuft of grass between the tiles, and fallen leaves.
    root, out = planted(420, (0.5, 0.52, 0.0), 0.17)
    shapes.append(plant(strips(root, upward(420, 0.5, rng) + 0.5 * out, rng.uniform(0.12, 0.36, 420), rng.uniform(0.006, 0.013, 420),
                                rng.uniform(0.2, 1.6, 420), blade, rng), gradient((60, 76, 20), (206, 204, 96), rng)))
    n = 20
    turn, r = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.55, 0.9, n)
    root = np.stack([r * np.cos(turn), r * np.sin(turn), np.full(n, 0.012)], 1)
    turn = rng.uniform(0, 2 * np.pi, n)
    heading = np.stack([np.cos(turn), np.sin(turn), np.full(n, 0.25)], 1)
    shapes.append(plant(strips(root, heading, rng.uniform(0.1, 0.16, n), rng.uniform(0.045, 0.06, n), np.full(n, 0.45), leaf, rng, 10),
                        gradient((150, 50, 20), (232, 150, 40), rng)))
    return shapes
