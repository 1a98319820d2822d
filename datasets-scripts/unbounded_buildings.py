"""Houses and a church tower for the unbounded scenes. Lengths in metres, z is up."""

import numpy as np

from procedural import as_texture, flat, shape
from unbounded_parts import at, box_part, joined, mixed, quad, revolved, tile_noise


def wall_texture(rng, width, height, columns, floors, plaster, frame, brick=False, door=True, per_metre=64):
    """A facade of width x height metres: plaster or bricks, a plinth, windows with panes, shutters or curtains, a door."""
    w, h = int(width * per_metre), int(height * per_metre)
    x, y = np.meshgrid((np.arange(w) + 0.5) / per_metre, height - (np.arange(h) + 0.5) / per_metre)
    dirt = at(tile_noise(rng), x, y, 8.0)
    fine = at(tile_noise(rng, 256, 0.4), x, y, 2.0)
    image = np.array(plaster, float) * (1 + 0.06 * dirt + 0.04 * fine)[..., None]
    if brick:
        row = np.floor(y / 0.14)
        bx = x / 0.4 + 0.5 * (row % 2)
        shade = np.random.default_rng(rng.integers(1 << 30)).normal(size=(64, 256))[
            (row % 64).astype(int), (np.floor(bx) % 256).astype(int)
        ]
        image *= (1 + 0.13 * shade)[..., None]
        joint = (y / 0.14 % 1 < 0.14) | (bx % 1 < 0.06)
        image[joint] = np.array((196, 186, 170)) * (1 + 0.05 * fine[joint])[:, None]
    image[y < 0.7] = np.array((118, 112, 106)) * (1 + 0.1 * dirt + 0.06 * fine)[y < 0.7][:, None]
    storey, bay = height / floors, width / columns
    glass_tint = rng.uniform(0.6, 1.5, (floors, columns))
    shutters = rng.uniform(size=(floors, columns)) < 0.55
    door_at = rng.integers(columns) if door else -1
    shutter = np.array([(44, 92, 70), (60, 84, 128), (128, 52, 40), (92, 70, 48)][rng.integers(4)], float)
    for f in range(floors):
        for c in range(columns):
            cx, base = (c + 0.5) * bay, f * storey
            is_door = f == 0 and c == door_at
            half, low, high = (0.55, 0.0, 2.15) if is_door else (0.48, base + 0.95, base + min(2.35, storey - 0.3))
            inside = (np.abs(x - cx) < half) & (y > low) & (y < high)
            surround = (np.abs(x - cx) < half + 0.12) & (y > low - 0.1) & (y < high + 0.14) & ~inside
            image[surround] = np.array(frame, float) * (1 + 0.04 * fine[surround])[:, None]
            px, py = (x - cx)[inside] / half, (y[inside] - low) / (high - low)
            if is_door:
                panel = (np.abs(np.abs(px) - 0.5) < 0.33) & (np.abs(py % 0.5 - 0.25) < 0.18)
                colour = np.where(panel[:, None], shutter * 0.75, shutter)
                colour[(np.abs(px - 0.8) < 0.06) & (np.abs(py - 0.45) < 0.02)] = (214, 180, 90)
            else:
                colour = mixed((30, 38, 48), (104, 128, 150), py + 0.3 * px + 0.2 * dirt[inside]) * glass_tint[f, c]
                curtain = (np.abs(px) > 0.55 + 0.1 * np.sin(9 * py + c)) & (py > 0.15)
                colour[curtain] = (206, 200, 188)
                bar = (np.abs(px) < 0.07) | (np.abs(px) > 0.9) | (np.abs(py - 0.62) < 0.03) | (py < 0.05) | (py > 0.95)
                colour[bar] = frame
            image[inside] = colour
            if shutters[f, c] and not is_door:
                leaves = (np.abs(np.abs(x - cx) - half - 0.38) < 0.25) & (y > low) & (y < high)
                image[leaves] = shutter * (1 - 0.35 * ((y[leaves] / 0.09) % 1 < 0.3)[:, None])
    image[y > height - 0.25] = np.array(frame, float) * 0.9
    return as_texture(image)


def roof_texture(rng, width=512, height=256, colour=(150, 74, 50)):
    y, x = np.meshgrid((np.arange(height) + 0.5) / height * 14, (np.arange(width) + 0.5) / width * 28, indexing="ij")
    row = np.floor(y)
    cx = x + 0.5 * (row % 2)
    shade = rng.normal(size=(14, 30))[row.astype(int), np.floor(cx).astype(int)]
    image = np.array(colour, float) * (1 + 0.14 * shade + 0.1 * at(tile_noise(rng), x, y, 28.0))[..., None]
    edge = (y % 1 > 0.8 + 0.15 * np.cos(2 * np.pi * cx)) | (cx % 1 < 0.06)
    image[edge] *= 0.5
    return as_texture(image)


def house(centre, size, turn, rng, plaster, floors=2, columns=3, brick=False, roof=(150, 74, 50), roof_height=2.2):
    """Four walls with their own textures and a gabled roof that runs along x."""
    x, y, z = np.asarray(size, float) / [2, 2, 1]
    c, s = np.cos(turn), np.sin(turn)
    place = lambda p: np.asarray(p, float) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + centre
    shapes, frame = [], [(232, 226, 214), (206, 192, 170), (240, 238, 232)][rng.integers(3)]
    ring = [(-x, -y), (x, -y), (x, y), (-x, y)]
    for i in range(4):
        a, b = ring[i], ring[(i + 1) % 4]
        length = np.hypot(a[0] - b[0], a[1] - b[1])
        bays = max(1, round(columns * length / size[0]))
        texture = wall_texture(rng, length, z, bays, floors, plaster, frame, brick, door=i % 2 == 0, per_metre=40)
        shapes.append(quad(place([(*a, 0), (*b, 0), (*b, z), (*a, z)]), texture))
    over, top = 0.4, z + roof_height
    tiles = roof_texture(rng, colour=roof)
    drop = over * roof_height / y
    for side in (-1, 1):
        low = [(-side * -x - side * -over, side * (y + over), z - drop), (side * -x - side * over, side * (y + over), z - drop)]
        shapes.append(quad(place([*low, (side * -(x + over), 0, top), (side * (x + over), 0, top)]), tiles))
        gable = place([(side * x, -y, z), (side * x, y, z), (side * x, 0, top)])
        shapes.append(shape(gable, [[0, 0], [1, 0], [0.5, 1]], [[0, 1, 2]], as_texture(np.array(plaster, float) * np.ones((2, 2, 1)))))
    shapes.append(
        joined([box_part(place((x * 0.5, y * 0.3, z + roof_height * 0.5)), (0.7, 0.7, roof_height * 0.9), turn)], flat((134, 84, 66)))
    )
    return shapes


def tower(spot, rng, width=5.0, height=21.0):
    """A church tower with a pointed roof."""
    shapes = []
    texture = wall_texture(rng, width, height, 1, 5, (196, 184, 164), (160, 148, 130), True, False, 24)
    positions, uvs, triangles = box_part(spot, (width, width, height), 0.4)
    shapes.append(shape(positions, uvs, triangles, texture))
    shapes.append(
        revolved(
            [(width * 0.78, 0), (width * 0.3, 3.5), (0.01, 10.0)],
            np.add(spot, (0, 0, height)),
            roof_texture(rng, colour=(84, 92, 96)),
            0.0,
            8,
        )
    )
    return shapes
