"""A living room seen from inside in all directions, with a garden behind its windows: the cameras' axes do not meet in
front of them.

A scene: shapes, sky [H, W, 3], sun (the direction of its light), indoor shapes, lamps (position, watts per steradian),
poses, camera; every number from one seed. Lengths in metres, z is up."""

import numpy as np

from demo_scene import globe_texture, vase_texture
from procedural import as_texture, flat, glyph_band, shape, smooth_profile, sphere
from unbounded_land import FIELDS, hills, meadow, sky
from unbounded_parts import (
    CAMERA,
    VIEWS,
    at,
    box_part,
    bush,
    grass,
    joined,
    look,
    mixed,
    over_square,
    quad,
    revolved,
    square_ring,
    tile_noise,
    tree,
    tube_part,
)

# Size of the room, centred at the origin: 7 m by 5 m, 2.7 m high.
X, Y, HIGH = 3.5, 2.5, 2.7
# Panes of the wall at +x as (from, to, sill, lintel), along y.
WINDOWS = [(-1.9, -0.25, 0.8, 2.3), (0.25, 1.9, 0.8, 2.3)]


def canvas(width, height, per_metre):
    """Texel centres (x, y) in metres, y upwards, of a texture of this size."""
    line = lambda length: (np.arange(int(length * per_metre)) + 0.5) / per_metre
    return np.meshgrid(line(width), height - line(height))


def parquet(rng, per_metre=150):
    """Herringbone of small boards."""
    x, y = canvas(2 * X, 2 * Y, per_metre)
    a, b = (x + y) / np.sqrt(2) / 0.09, (x - y) / np.sqrt(2) / 0.09
    i, j = np.floor(a), np.floor(b)
    lies = (i - j) % 8 < 4
    board, along = np.where(lies, j, i), np.where(lies, i + j, j - i)
    key = (board * 131 + np.floor(along / 4) * 71 + lies * 17).astype(int) % 997
    shade, tint = rng.normal(size=997)[key], rng.uniform(size=997)[key]
    grain = at(tile_noise(rng, 512, 0.7), np.where(lies, x * 1.0, y * 4.0), np.where(lies, y * 4.0, x * 1.0), 2.0)
    image = mixed((142, 92, 52), (188, 138, 86), tint) * (1 + 0.07 * shade + 0.06 * grain)[..., None]
    edge = np.minimum(np.where(lies, b % 1, a % 1), 1 - np.where(lies, b % 1, a % 1))
    image[edge < 0.05] *= 0.55
    return as_texture(image)


def wallpaper(rng, width, height, colour, ink, per_metre=110):
    """Tendrils in columns above a panelled dado."""
    x, y = canvas(width, height, per_metre)
    dirt = at(tile_noise(rng), x, y, 5.0)
    image = np.array(colour, float) * (1 + 0.03 * dirt)[..., None]
    column = x % 0.5 - 0.25
    stem = np.abs(column - 0.09 * np.sin(2 * np.pi * y / 0.62)) < 0.011
    u, v = column + 0.1 * np.cos(2 * np.pi * y / 0.62), y % 0.155 - 0.078
    foliage = (u / 0.06) ** 2 + (v / 0.032) ** 2 < 1
    bloom = np.hypot(column - 0.05, (y + 0.25 * np.floor(x / 0.5)) % 0.62 - 0.31) < 0.055
    image[stem | foliage] = np.array(ink, float) * (1 + 0.1 * dirt[stem | foliage])[:, None]
    image[bloom] = mixed((206, 96, 84), (240, 196, 120), 0.5 + 0.3 * dirt[bloom])
    dado = y < 0.85
    wood = np.array((232, 226, 212), float) * (1 + 0.02 * at(tile_noise(rng, 256, 0.6), x * 3, y, 2.0))[..., None]
    image[dado] = wood[dado]
    rim = np.maximum(np.abs(x % 0.6 - 0.3) / 0.24, np.abs(y - 0.45) / 0.28)
    image[dado & (np.abs(rim - 1) < 0.06)] *= 0.72
    image[(y < 0.1) | (np.abs(y - 0.85) < 0.03)] = (202, 192, 172)
    image[y > height - 0.08] = (240, 236, 226)
    return as_texture(image)


def rug(rng, width=2.6, height=1.8, per_metre=150):
    """Medallions in frames."""
    x, y = canvas(width, height, per_metre)
    u, v = x - width / 2, y - height / 2
    weave = 1 + 0.08 * np.sin(2 * np.pi * x * 60) * np.sin(2 * np.pi * y * 60) + 0.06 * at(tile_noise(rng), x, y, 2.0)
    image = np.full((*x.shape, 3), (132, 34, 38), float)
    frame = np.maximum(np.abs(u) / (width / 2), np.abs(v) / (height / 2))
    star = np.hypot(u, 1.3 * v) * (1 + 0.25 * np.cos(8 * np.arctan2(1.3 * v, u)))
    for radius, ink in [(0.75, (38, 48, 92)), (0.6, (214, 178, 110)), (0.52, (150, 46, 44)), (0.32, (38, 48, 92)), (0.16, (226, 206, 160))]:
        image[star < radius] = ink
    buds = (np.hypot(x % 0.26 - 0.13, y % 0.26 - 0.13) < 0.05) & (star > 0.8)
    image[buds] = (208, 168, 96)
    image[frame > 0.84] = (36, 44, 84)
    image[(frame > 0.84) & (np.sin(2 * np.pi * (x + y) / 0.12) > 0.3)] = (220, 190, 130)
    image[(frame > 0.95) | (np.abs(frame - 0.83) < 0.015)] = (230, 214, 176)
    return as_texture(image * weave[..., None])


def painting(rng, width, height, per_metre=260):
    """Hills under a sky in strokes, in a gilded frame."""
    x, y = canvas(width, height, per_metre)
    noise = [at(tile_noise(rng, 256, falloff), x, y, 1.3) for falloff in (1.6, 1.0, 0.3)]
    hues = rng.permutation([(60, 92, 140), (222, 150, 90), (88, 116, 60), (150, 60, 70), (232, 204, 140)]).astype(float)
    image = mixed(hues[0], hues[1], y / height + 0.15 * noise[1])
    for level, hue in zip((0.62, 0.45, 0.28), hues[2:]):
        image[y < height * (level + 0.07 * noise[0])] = hue
    image *= (1 + 0.12 * noise[1] + 0.1 * noise[2])[..., None]
    edge = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
    rim = edge < 0.06
    image[rim] = np.array((188, 148, 70)) * (0.75 + 0.3 * np.sin(edge[rim] / 0.06 * np.pi) + 0.08 * noise[2][rim])[:, None]
    return as_texture(image)


def shelf(rng, corner, width, rows, wood):
    """Boards and books against the wall at +y; `corner` is its lower left on the wall."""
    x0, y0, z0 = corner
    pitch, depth = 0.34, 0.28
    boards = [box_part((x0 + width / 2, y0 - depth / 2, z0 + pitch * k), (width, depth, 0.025)) for k in range(rows + 1)]
    boards += [box_part((x, y0 - depth / 2, z0), (0.025, depth, pitch * rows + 0.025)) for x in (x0, x0 + width)]
    shapes, inks = [joined(boards, wood)], [(150, 40, 40), (36, 60, 110), (40, 92, 66), (206, 170, 96), (90, 60, 100), (228, 220, 200), (60, 56, 54)]
    for k in range(rows):
        x = x0 + 0.03
        while x < x0 + width - 0.07:
            thick, tall, deep = rng.uniform(0.02, 0.055), rng.uniform(0.19, 0.3), rng.uniform(0.15, 0.22)
            if rng.uniform() < 0.06:
                x += rng.uniform(0.05, 0.2)
                continue
            ink = np.array(inks[int(rng.integers(len(inks)))], float) * rng.uniform(0.8, 1.15)
            spine = np.full((64, 12, 3), ink)
            for low, high in ((6, 9), (50, 56)):
                spine[low:high] = ink * 0.55 + 90
            spine[20:42:3, 3:9] = 225 if ink.mean() < 130 else 50
            shapes.append(joined([box_part((x + thick / 2, y0 - deep / 2 - 0.02, z0 + pitch * k + 0.025), (thick, deep, tall))], as_texture(spine)))
            x += thick + 0.002
    return shapes


def plant_pot(spot, size, rng, leaves, dark, light, leaf_size=0.16):
    """A glazed pot with leaves in all directions."""
    profile = [(size * 0.6, 0), (size * 0.95, size * 1.5), (size, size * 1.6), (size * 0.86, size * 1.55)]
    pot = revolved(profile, spot, as_texture(np.array((86, 116, 130), float) * (1 + 0.1 * tile_noise(rng, 128, 0.8))[..., None]), 1.0, 32)
    return [pot, bush(np.add(spot, (0, 0, size * 1.5)), (size * 1.7, size * 1.7, size * 3.2), rng, leaves, leaf_size, dark, light)]


def fringe(rng, corners, count):
    """Threads along the two short ends of the rug."""
    (x0, y0), (x1, y1) = corners
    parts = []
    for x, side in ((x0, -1), (x1, 1)):
        for y in np.linspace(y0, y1, count):
            wobble = 0.012 * rng.normal(size=3)
            parts.append(tube_part([(x, y, 0.018), (x + side * 0.035, y + wobble[0], 0.014), (x + side * 0.075, y + wobble[1], 0.008)], 0.003, 3))
    return joined(parts, flat((232, 220, 190)))


def curtain(rng, y0, y1, colour):
    """Cloth in folds in front of the wall at +x."""
    y, z = np.meshgrid(np.linspace(y0, y1, 64), np.linspace(0.03, 2.45, 24))
    fold = 0.045 * np.sin(2 * np.pi * (y - y0) / 0.11 + 0.6 * np.sin(3 * z)) * (0.6 + 0.4 * (2.45 - z) / 2.45)
    positions = np.stack([X - 0.12 + fold, y, z], -1).reshape(-1, 3)
    uvs = np.stack([(y - y0) / (y1 - y0), z / 2.45], -1).reshape(-1, 2)
    r, c = np.meshgrid(np.arange(23), np.arange(63), indexing="ij")
    a = (64 * r + c).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + 65], 1), np.stack([a, a + 65, a + 64], 1)])
    u, v = np.meshgrid(np.linspace(0, 1, 96), np.linspace(1, 0, 512))
    image = np.array(colour, float) * (1 + 0.05 * tile_noise(rng, 512, 0.6)[:, :96])[..., None]
    image[np.abs(v * 14 % 1 - 0.5) < 0.07] *= 0.7
    image[(np.hypot(u * 4 % 1 - 0.5, (v * 14 + 0.5) % 1 - 0.5) < 0.2)] = (236, 214, 150)
    return shape(positions, uvs, triangles, as_texture(image))


def wall_with_windows(texture):
    """The wall at +x as strips around its panes, which are open."""
    shapes, rows = [], [0, WINDOWS[0][2], WINDOWS[0][3], HIGH]
    columns = sorted({-Y, Y, *(edge for window in WINDOWS for edge in window[:2])})
    for z0, z1 in zip(rows, rows[1:]):
        for y0, y1 in zip(columns, columns[1:]):
            if z0 == WINDOWS[0][2] and any(window[0] == y0 for window in WINDOWS):
                continue
            # Seen from inside: y runs to the left.
            u = lambda y: (Y - y) / (2 * Y)
            uvs = [[u(y1), z0 / HIGH], [u(y0), z0 / HIGH], [u(y0), z1 / HIGH], [u(y1), z1 / HIGH]]
            shapes.append(shape([(X, y1, z0), (X, y0, z0), (X, y0, z1), (X, y1, z1)], uvs, [[0, 1, 2], [0, 2, 3]], texture))
    frames = []
    for y0, y1, z0, z1 in WINDOWS:
        for y in (y0, (y0 + y1) / 2, y1):
            frames.append(box_part((X, y, z0), (0.12, 0.06, z1 - z0)))
        for z in (z0 - 0.03, (z0 + z1) * 0.56, z1 - 0.03):
            frames.append(box_part((X, (y0 + y1) / 2, z), (0.12, y1 - y0, 0.05)))
        frames.append(box_part((X - 0.12, (y0 + y1) / 2, z0 - 0.06), (0.3, y1 - y0 + 0.1, 0.04)))
    return shapes + [joined(frames, flat((238, 234, 224)))]


def room(seed=61):
    """Cameras turn all around in two laps through the middle of the room."""
    rng = np.random.default_rng(seed)
    wood = as_texture(np.array((122, 78, 46), float) * (1 + 0.12 * tile_noise(rng, 256, 0.8))[..., None])
    shapes = [quad([(-X, -Y, 0), (X, -Y, 0), (X, Y, 0), (-X, Y, 0)], parquet(rng))]
    plaster = as_texture(np.array((236, 232, 222), float) * (1 + 0.025 * tile_noise(rng, 512, 0.9))[..., None])
    shapes.append(quad([(-X, Y, HIGH), (X, Y, HIGH), (X, -Y, HIGH), (-X, -Y, HIGH)], plaster))
    paper, ink = (206, 214, 190), (96, 128, 92)
    shapes.append(quad([(X, -Y, 0), (-X, -Y, 0), (-X, -Y, HIGH), (X, -Y, HIGH)], wallpaper(rng, 2 * X, HIGH, paper, ink)))
    shapes.append(quad([(-X, Y, 0), (X, Y, 0), (X, Y, HIGH), (-X, Y, HIGH)], wallpaper(rng, 2 * X, HIGH, paper, ink)))
    shapes.append(quad([(-X, -Y, 0), (-X, Y, 0), (-X, Y, HIGH), (-X, -Y, HIGH)], wallpaper(rng, 2 * Y, HIGH, (190, 196, 214), (110, 110, 150))))
    shapes += wall_with_windows(wallpaper(rng, 2 * Y, HIGH, paper, ink))

    # On the floor and the walls.
    shapes.append(joined([box_part((-0.5, 0.0, 0.0), (2.6, 1.8, 0.015))], flat((120, 40, 40))))
    shapes.append(quad([(-1.8, -0.9, 0.017), (0.8, -0.9, 0.017), (0.8, 0.9, 0.017), (-1.8, 0.9, 0.017)], rug(rng)))
    shapes.append(fringe(rng, ((-1.8, -0.88), (0.8, 0.88)), 110))
    for x, z, width, height in [(-2.3, 1.25, 0.9, 0.65), (-0.9, 1.2, 0.7, 0.9), (0.5, 1.3, 1.1, 0.7), (2.0, 1.2, 0.6, 0.8)]:
        y = -Y + 0.02
        shapes.append(quad([(x + width, y, z), (x, y, z), (x, y, z + height), (x + width, y, z + height)], painting(rng, width, height)))
    for y, z, width, height in [(-1.7, 1.2, 1.2, 0.9), (0.5, 1.25, 0.8, 0.8)]:
        x = -X + 0.02
        shapes.append(quad([(x, y, z), (x, y + width, z), (x, y + width, z + height), (x, y, z + height)], painting(rng, width, height)))
    poster = as_texture(glyph_band(420, 300, 5, rng, (40, 50, 90), (238, 228, 200)))
    shapes.append(quad([(1.6, Y - 0.02, 1.2), (2.6, Y - 0.02, 1.2), (2.6, Y - 0.02, 1.9), (1.6, Y - 0.02, 1.9)], poster))
    shapes += shelf(rng, (-2.9, Y, 0.05), 2.2, 6, wood) + shelf(rng, (0.0, Y, 0.05), 1.3, 4, wood)
    for y0, y1 in [(-2.35, -1.95), (-0.2, 0.2), (1.95, 2.35)]:
        shapes.append(curtain(rng, y0, y1, (168, 72, 60)))

    # A sofa below the paintings, a table with a vase and a globe, a chest, plants, a hanging lamp with a fringe of beads.
    cloth = as_texture(np.array((70, 98, 120), float) * (1 + 0.07 * tile_noise(rng, 256, 0.5))[..., None])
    sofa = [box_part((-0.4, -2.05, 0.12), (2.2, 0.85, 0.3)), box_part((-0.4, -2.38, 0.4), (2.2, 0.2, 0.45))]
    sofa += [box_part((-0.4 + side * 1.05, -2.05, 0.12), (0.18, 0.85, 0.5)) for side in (-1, 1)]
    shapes.append(joined(sofa, cloth))
    checks = np.indices((128, 128)).sum(0)
    for x, turn in ((-1.1, 0.25), (0.3, -0.3)):
        pillow = np.where((checks // 16 % 2)[..., None], (226, 180, 70), (236, 226, 200)).astype(np.uint8)
        shapes.append(joined([box_part((x, -2.2, 0.43), (0.42, 0.14, 0.4), turn)], pillow))
    legs = [tube_part([(2.35 + a, -1.35 + b, 0), (2.35 + a, -1.35 + b, 0.7)], 0.028, 8) for a in (-0.5, 0.5) for b in (-0.4, 0.4)]
    shapes.append(joined([box_part((2.35, -1.35, 0.7), (1.2, 1.0, 0.04)), *legs], wood))
    vase = smooth_profile([(0.09, 0), (0.14, 0.1), (0.17, 0.24), (0.1, 0.4), (0.07, 0.48), (0.1, 0.54)], 64)
    shapes.append(revolved(vase, (2.2, -1.45, 0.74), vase_texture(rng, 1024, 512), 1.0, 64))
    shapes.append(grass((2.2, -1.45, 1.2), 0.05, 60, 0.42, 0.012, rng, (50, 80, 40), (200, 190, 96)))
    positions, uvs, triangles, normals = sphere((2.65, -1.1, 0.98), 0.2)
    shapes.append(shape(positions, uvs, triangles, globe_texture(rng), normals, 1.0))
    shapes.append(revolved([(0.12, 0), (0.11, 0.02), (0.03, 0.05), (0.02, 0.06)], (2.65, -1.1, 0.74), wood))
    shapes.append(joined([box_part((-3.15, -0.1, 0), (0.6, 1.4, 0.75))], wood))
    shapes += plant_pot((-3.1, -0.5, 0.75), 0.13, rng, 420, (24, 66, 34), (120, 170, 90), 0.12)
    shapes += plant_pot((3.0, 2.05, 0.0), 0.22, rng, 900, (26, 60, 30), (136, 176, 80), 0.18)
    shapes += plant_pot((-3.05, 2.0, 0.0), 0.2, rng, 700, (40, 70, 20), (176, 190, 70), 0.2)
    shapes += plant_pot((3.3, -2.15, 0.0), 0.17, rng, 600, (90, 30, 50), (190, 90, 110), 0.14)
    shade = [(0.34, 0.0), (0.2, 0.26), (0.08, 0.3)]
    shapes.append(revolved(shade, (0.4, 0.2, 2.05), as_texture(glyph_band(512, 96, 9, rng, (150, 60, 40), (240, 224, 180))), 0.0, 40))
    cord = [tube_part([(0.4, 0.2, 2.35), (0.4, 0.2, HIGH)], 0.01, 5)]
    for angle in np.linspace(0, 2 * np.pi, 90, endpoint=False):
        x, y = 0.4 + 0.34 * np.cos(angle), 0.2 + 0.34 * np.sin(angle)
        cord.append(tube_part([(x, y, 2.05), (x, y, 2.05 - rng.uniform(0.08, 0.12))], 0.004, 3))
    shapes.append(joined(cord, flat((196, 160, 90))))

    # Behind the windows: a meadow, trees, hills, a sky.
    indoors, shapes = shapes, []
    ground = meadow(rng)
    shapes.append(square_ring(0, 1600, over_square(lambda x, y: ground(x * 1.0, y), 1600, 1024)))
    shapes[-1]["positions"][:, 2] -= 0.4
    for spot, height in [((12, -5), 5.5), ((17, 2), 6.5), ((11, 6.5), 5.0), ((30, -14), 8.0), ((34, 13), 8.5)]:
        shapes += tree((*spot, -0.4), height, rng, 2500, 0.06 * height)
    shapes.append(hills(rng, 330, 1500, 260, FIELDS))

    poses = []
    for i in range(VIEWS):
        jitter = np.random.default_rng(seed * 1000 + i)
        lap, t = divmod(i, VIEWS // 2)
        angle = 2 * np.pi * (t + 0.5 * lap) / (VIEWS // 2)
        # In one lap the camera is displaced towards the side that it looks at, in the other lap away from it.
        away = (0.75, -0.7)[lap] + jitter.uniform(-0.08, 0.08)
        heading = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([-0.2, 0, 1.45]) + heading * away * [1.3, 1.0, 0] + [0, 0, (-0.15, 0.15)[lap] + jitter.uniform(-0.08, 0.08)]
        turned = angle + jitter.uniform(-0.12, 0.12)
        target = eye + [np.cos(turned), np.sin(turned), jitter.uniform(-0.22, 0.06)]
        poses.append(look(eye, target))
    # Many lamps, so that no place is quite dark; equal ones, so that the random choice among them adds little noise.
    lamps = [((x, y, (2.2, 1.1)[(i + j) % 2]), 1.1) for i, x in enumerate((-2.4, -0.8, 0.8, 2.4)) for j, y in enumerate((-1.1, 1.1))]
    return dict(shapes=shapes, sky=sky(rng, cover=0.0), sun=(-0.55, 0.35, -0.76), indoors=indoors, lamps=lamps, poses=poses, camera=CAMERA)
