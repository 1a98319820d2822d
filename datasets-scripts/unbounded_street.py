"""A street of houses, seen while walking down one side and up the other.

A scene: shapes, sky [H, W, 3], sun (the direction of its light), poses, camera; every number from one seed. Lengths in metres, z is up."""

import numpy as np

from demo_scene import vase_texture
from procedural import as_texture, flat, glyph_band, revolve, shape, smooth_profile
from unbounded_buildings import house, roof_texture, tower, wall_texture
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

NEAR_STREET = 48.0  # length of the cobbles' texture


def cobbles(rng, width=10.0, per_metre=72):
    """Rows of stones with joints, worn in two lanes; repeats along the street after NEAR_STREET."""
    h, w = int(NEAR_STREET * per_metre), int(width * per_metre)
    y, x = np.meshgrid((np.arange(h) + 0.5) / per_metre, (np.arange(w) + 0.5) / per_metre, indexing="ij")
    row = np.floor(y / 0.16).astype(int)
    column = x / 0.2 + 0.5 * (row % 2) + 0.35 * rng.normal(size=row.max() + 1)[row] * 0.3
    shade = rng.normal(size=(row.max() + 1, 64))[row, np.floor(column).astype(int) % 64]
    tint = rng.uniform(size=(row.max() + 1, 64))[row, np.floor(column).astype(int) % 64]
    bx, by = column % 1 - 0.5, (y / 0.16) % 1 - 0.5
    dome = np.clip(1.15 - 1.5 * np.maximum(np.abs(bx), np.abs(by)) ** 2 * 2, 0, 1)
    dirt = at(tile_noise(rng), x, y, 16.0)
    image = mixed((104, 102, 104), (146, 130, 112), tint) * ((1 + 0.13 * shade) * dome * (1 + 0.07 * dirt))[..., None]
    lane = np.minimum(np.abs(x - width * 0.36), np.abs(x - width * 0.64)) < 0.35
    image[lane] = image[lane] * 0.8 + 30
    image[np.maximum(np.abs(bx) * 1.05, np.abs(by)) > 0.44] = (70, 64, 56)
    gutter = np.abs(np.abs(x - width / 2) - width * 0.33) < 0.12
    image[gutter] = np.array((150, 146, 138)) * (1 + 0.08 * dirt[gutter] - 0.5 * (y[gutter] % 0.8 < 0.03))[:, None]
    return as_texture(image)


def street(seed=47):
    """A street of houses with lamps, wires, signs, a fountain and a tree; cameras walk down one side and up the other."""
    rng = np.random.default_rng(seed)
    shapes, half = [], 5.0
    y0, y1 = -48.0, 96.0
    shapes.append(quad([(-half, y0, 0), (half, y0, 0), (half, y1, 0), (-half, y1, 0)], cobbles(rng), (1, (y1 - y0) / NEAR_STREET)))
    ground = meadow(rng)
    shapes.append(square_ring(0, 1600, over_square(lambda x, y: ground(x * 1.0, y), 1600, 1024)))
    shapes[-1]["positions"][:, 2] -= 0.05

    plasters = [
        (226, 198, 150),
        (206, 132, 100),
        (186, 196, 178),
        (236, 222, 196),
        (170, 90, 70),
        (160, 176, 196),
        (224, 176, 120),
        (204, 188, 168),
    ]
    roofs = [(150, 74, 50), (96, 92, 96), (166, 96, 60), (128, 66, 54)]
    fittings, iron, wires = [], [], []
    for side in (-1, 1):
        y, i = y0, 0
        while y < y1 - 4:
            width, floors = rng.uniform(5.5, 9.0), int(rng.integers(2, 4))
            height = 3.05 * floors + rng.uniform(-0.2, 0.4)
            columns = int(round(width / 2.1))
            near = -14 < y + width / 2 < 34
            front = side * (half + rng.uniform(-0.15, 0.15))
            wall = wall_texture(
                rng,
                width,
                height,
                columns,
                floors,
                plasters[int(rng.integers(8))],
                (236, 230, 220),
                rng.uniform() < 0.3,
                True,
                72 if near else 32,
            )
            a, b = (y + width, y) if side < 0 else (y, y + width)
            # Seen from the street, so that the texture is not mirrored.
            shapes.append(quad([(front, b, 0), (front, a, 0), (front, a, height), (front, b, height)], wall))
            back, ridge = front + side * 8.0, height + rng.uniform(2.2, 3.2)
            tiles = roof_texture(rng, colour=roofs[int(rng.integers(4))])
            eave = front - side * 0.35
            shapes.append(
                quad([(eave, b, height - 0.1), (eave, a, height - 0.1), (front + side * 4, a, ridge), (front + side * 4, b, ridge)], tiles)
            )
            shapes.append(quad([(back, a, height), (back, b, height), (front + side * 4, b, ridge), (front + side * 4, a, ridge)], tiles))
            plain = wall_texture(rng, 8, height, 2, floors, plasters[int(rng.integers(8))], (200, 194, 184), False, False, 24)
            for end in (y, y + width):
                shapes.append(quad([(front, end, 0), (back, end, 0), (back, end, height), (front, end, height)], plain))
                shapes.append(
                    shape(
                        [(front, end, height), (back, end, height), (front + side * 4, end, ridge)],
                        [[0, 0], [1, 0], [0.5, 1]],
                        [[0, 1, 2]],
                        plain[:32],
                    )
                )
            shapes.append(quad([(back, a, 0), (back, b, 0), (back, b, height), (back, a, height)], plain))
            chimney = np.array([front + side * 4, y + width * rng.uniform(0.25, 0.75), ridge - 0.4])
            fittings.append(box_part(chimney, (0.7, 0.6, 1.5)))
            # Protruding parts: sills, a cornice, a rain pipe, balconies with thin rails.
            bay, storey = width / columns, height / floors
            for f in range(floors):
                for c in range(columns):
                    fittings.append(box_part((front - side * 0.08, y + (c + 0.5) * bay, f * storey + 0.86), (0.2, 1.2, 0.07)))
                    if near and f > 0 and rng.uniform() < 0.3:
                        middle = y + (c + 0.5) * bay
                        fittings.append(box_part((front - side * 0.45, middle, f * storey + 0.02), (0.9, 1.7, 0.1)))
                        rail = [
                            (front, middle - 0.8),
                            (front - side * 0.85, middle - 0.8),
                            (front - side * 0.85, middle + 0.8),
                            (front, middle + 0.8),
                        ]
                        iron.append(tube_part([(*p, f * storey + 1.05) for p in rail], 0.022, 5))
                        iron += [
                            tube_part([(front - side * 0.85, q, f * storey + 0.1), (front - side * 0.85, q, f * storey + 1.05)], 0.011, 4)
                            for q in np.linspace(middle - 0.8, middle + 0.8, 12)
                        ]
            fittings.append(box_part((front - side * 0.1, y + width / 2, height - 0.12), (0.3, width, 0.16)))
            iron.append(tube_part([(front - side * 0.08, y + 0.12, 0), (front - side * 0.08, y + 0.12, height)], 0.05, 6))
            if near and rng.uniform() < 0.6:
                shapes += awning(front, side, y + width / 2, width * 0.5, rng)
            if near and rng.uniform() < 0.7:
                shapes += sign(front, side, y + width * 0.15, rng, iron)
            gap = rng.uniform(2.0, 4.0) if i % 4 == 3 else 0.0
            y, i = y + width + gap, i + 1
    shapes.append(joined(fittings, as_texture(np.array((186, 178, 164), float) * (1 + 0.07 * tile_noise(rng, 64, 0.8))[..., None])))

    for i, y in enumerate(np.arange(-34, 90, 12.0)):
        iron += lamp((3.55 if i % 2 else -3.55, y, 0), shapes)
        sag = np.linspace(-1, 1, 21)[:, None]
        for k in range(2 if -14 < y < 40 else 1):
            ends = np.array([-half, y + 5 + k * 1.3, 5.6 + 0.4 * k]), np.array([half, y + 6.5 - k * 2, 5.9 - 0.3 * k])
            wires.append(tube_part((ends[0] + ends[1]) / 2 + sag * (ends[1] - ends[0]) / 2 - (1 - sag**2) * [0, 0, 0.5], 0.014, 4))
    shapes += bunting(rng, wires)
    shapes.append(joined(iron + wires, flat((38, 40, 42))))

    # In the middle: a fountain; farther on a tree in a round bed, a cart, pots in front of the doors.
    stone = as_texture(np.array((178, 168, 150), float) * (1 + 0.09 * tile_noise(rng, 256, 0.8))[..., None])
    basin = [(1.5, 0.0), (1.55, 0.05), (1.45, 0.12), (1.4, 0.5), (1.5, 0.58), (1.5, 0.66), (1.3, 0.66), (1.28, 0.45)]
    shapes.append(revolved(basin, (0.2, 7.0, 0), stone, 0.0, 48))
    shapes.append(revolved([(1.29, 0.5), (0.6, 0.5), (0.01, 0.5)], (0.2, 7.0, 0), flat((70, 110, 112)), 1.0, 48))
    column = smooth_profile([(0.3, 0.4), (0.22, 0.6), (0.14, 0.9), (0.2, 1.2), (0.55, 1.45), (0.6, 1.52)], 48)
    shapes.append(revolved(column, (0.2, 7.0, 0), vase_texture(rng, 1024, 512), 1.0, 64))
    shapes.append(revolved([(0.6, 1.52), (0.3, 1.5), (0.1, 1.5), (0.08, 1.75), (0.01, 1.8)], (0.2, 7.0, 0), stone))
    shapes.append(revolved([(1.1, 0.0), (1.1, 0.45), (1.0, 0.47), (0.01, 0.4)], (-0.6, 17.0, 0), stone, 0.0, 32))
    shapes += tree((-0.6, 17.0, 0.4), 5.6, rng, 5000, 0.2)
    shapes.append(grass((-0.6, 17.0, 0.42), 0.95, 700, 0.3, 0.016, rng))
    shapes += tree((0.8, 40.0, 0), 7.0, rng, 4000, 0.26, (110, 60, 24), (222, 160, 60))
    for _ in range(16):
        side, y = rng.choice((-1, 1)), rng.uniform(-14, 26)
        size = rng.uniform(0.22, 0.36)
        spot = np.array([side * rng.uniform(4.1, 4.5), y, 0])
        shapes.append(
            revolved(
                [(size * 0.6, 0), (size * 0.95, size * 1.4), (size, size * 1.5), (size * 0.85, size * 1.5)],
                spot,
                flat((168, 88, 56)),
                0.0,
                24,
            )
        )
        dark, light = [((30, 62, 34), (110, 156, 84)), ((120, 30, 50), (236, 120, 140)), ((60, 70, 20), (232, 200, 80))][
            int(rng.integers(3))
        ]
        shapes.append(bush(spot + [0, 0, size * 1.3], (size * 1.5, size * 1.5, size * 2), rng, 380, 0.11, dark, light))

    # The ends of the street: a square with a church and trees, behind everything hills.
    shapes += tower((6.5, 118, 0), rng, 7.0, 26.0)
    for spot, size, turn in [((-15, 112), (12, 8, 5), 0.2), ((0, -66), (16, 8, 6.5), 0.0), ((-18, -60), (12, 8, 7), 0.3)]:
        shapes += house((*spot, 0), size, turn, rng, plasters[int(rng.integers(8))], 2, 4)
    for spot in [(-9, 104), (11, 102), (-6, -55), (6, -56)]:
        shapes += tree((*spot, 0), 8.5, rng, 2500, 0.34)
    shapes.append(hills(rng, 330, 1500, 260, FIELDS))

    poses = []
    for i in range(VIEWS):
        jitter = np.random.default_rng(seed * 1000 + i)
        there, t = i < VIEWS // 2, (i % (VIEWS // 2)) / (VIEWS / 2 - 1)
        y = -7.0 + 9.5 * t if there else 2.5 - 9.5 * t
        side = -1 if there else 1
        eye = (side * (2.1 + 0.5 * np.sin(5 * t)) + jitter.uniform(-0.1, 0.1), y, 1.65 + jitter.uniform(-0.15, 0.25))
        # The viewing direction swings from wall to wall, around the fountain and the view behind it.
        target = (
            0.2 + 3.2 * np.sin(2 * np.pi * 3 * t + (0 if there else 2)) + jitter.uniform(-0.4, 0.4),
            max(7.0, y + 6.5),
            1.75 + jitter.uniform(-0.25, 0.55),
        )
        poses.append(look(eye, target))
    return dict(shapes=shapes, sky=sky(rng, cover=-0.1), sun=(0.3, 0.42, -0.86), poses=poses, camera=CAMERA)


def awning(front, side, middle, width, rng):
    """Striped cloth over a shop."""
    colours = [((178, 40, 40), (240, 232, 216)), ((30, 90, 80), (236, 226, 196)), ((40, 60, 120), (240, 236, 228))][int(rng.integers(3))]
    stripes = np.repeat(np.array([colours[i % 2] for i in range(14)], np.uint8)[None], 2, 0)
    out, a, b = front - side * 1.3, middle - width / 2, middle + width / 2
    return [
        quad([(out, a, 2.35), (out, b, 2.35), (front, b, 2.95), (front, a, 2.95)], np.repeat(stripes, 12, 1)),
        quad([(out, a, 2.12), (out, b, 2.12), (out, b, 2.35), (out, a, 2.35)], np.repeat(stripes, 12, 1)),
    ]


def sign(front, side, y, rng, iron):
    """A board with letters that hangs out over the street."""
    ink, paper = [((240, 226, 180), (60, 30, 24)), ((30, 40, 70), (236, 220, 180)), ((250, 250, 240), (30, 80, 66))][int(rng.integers(3))]
    board = as_texture(glyph_band(192, 96, 4, rng, ink, paper))
    out, z = front - side * 1.0, 3.0
    iron.append(tube_part([(front, y, z + 0.6), (out, y, z + 0.6)], 0.02, 5))
    return [quad([(out, y, z), (front - side * 0.15, y, z), (front - side * 0.15, y, z + 0.5), (out, y, z + 0.5)], board)]


def lamp(spot, shapes):
    """A post with a lantern; its iron part is returned, its glass is added to `shapes`."""
    spot = np.asarray(spot, float)
    positions, uvs, triangles, _ = revolve(np.array([(0.1, 0), (0.1, 0.3), (0.05, 0.45), (0.045, 3.2), (0.08, 3.25)]), spot, 10)
    shapes.append(revolved([(0.09, 3.25), (0.17, 3.6), (0.17, 3.62)], spot, flat((232, 222, 190)), 1.0, 8))
    cap = revolve(np.array([(0.2, 3.62), (0.05, 3.8), (0.01, 3.95)]), spot, 8)
    return [(positions, uvs, triangles), cap[:3]]


def bunting(rng, wires):
    """Small flags on two strings across the street."""
    shapes, colours = [], [(206, 50, 44), (240, 190, 60), (40, 100, 160), (240, 236, 226), (50, 130, 80)]
    for y in (4.0, 12.0):
        s = np.linspace(-1, 1, 31)[:, None]
        string = np.array([0, y, 4.5]) + s * [5.0, 1.2, 0] - (1 - s**2) * [0, 0, 0.55]
        wires.append(tube_part(string, 0.012, 4))
        for k in range(1, 30, 2):
            p, q = string[k], string[k + 1]
            tip = (p + q) / 2 - [0, 0.08 * rng.normal(), 0.34]
            shapes.append(shape([p, q, tip], [[0, 1], [1, 1], [0.5, 0]], [[0, 1, 2]], flat(colours[int(rng.integers(5))])))
    return shapes
