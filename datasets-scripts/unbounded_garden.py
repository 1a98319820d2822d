"""A laid table in a garden, seen from a ring of cameras.

A scene: shapes, sky [H, W, 3], sun (the direction of its light), poses, camera; every number from one seed. Lengths in metres, z is up."""

import numpy as np

from demo_scene import globe_texture, tile_texture, vase_texture
from procedural import as_texture, directions_on_sphere, flat, gradient, leaf, merged, plant, shape, smooth_profile, sphere, strips
from unbounded_buildings import house, tower
from unbounded_land import FIELDS, hills, meadow, sky
from unbounded_parts import (
    CAMERA,
    VIEWS,
    at,
    bark,
    box_part,
    bush,
    grass,
    joined,
    look,
    over_square,
    revolved,
    square_ring,
    tile_noise,
    tree,
    tube_part,
)


def garden(seed=31):
    """A laid table on a tiled terrace with grass and a bush around it, a fence, trees, houses and hills; a ring of
    cameras."""
    rng = np.random.default_rng(seed)
    colour = meadow(rng)
    shapes = [
        square_ring(0, 6, over_square(colour, 6, 1536)),
        square_ring(6, 50, over_square(colour, 50, 2048)),
        square_ring(50, 1600, over_square(colour, 1600, 2048)),
    ]
    angle = np.linspace(0, 2 * np.pi, 97)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) * [1.7, 1.7, 0] + [0, 0, 0.03]
    fan = np.stack([np.zeros(96, int), np.arange(1, 97), np.arange(1, 97) % 96 + 1], 1)
    disc = np.vstack([[0, 0, 0.03], rim])
    shapes.append(shape(disc, disc[:, :2] / 3.4 + 0.5, fan, tile_texture(rng, 1536, 14)))
    shapes.append(revolved([(1.7, -0.02), (1.7, 0.015), (1.7, 0.03)], (0, 0, 0), flat((150, 140, 126))))

    # The table: a turned leg, a top with its edge, on it a vase, a globe and a plate with fruit.
    wood = tile_noise(rng, 256, 0.9)
    u, v = np.meshgrid(np.linspace(0, 1, 768), np.linspace(0, 1, 768))
    planks = (
        np.array((150, 98, 58), float)
        * (1 + 0.1 * at(wood, u * 0.2, v, 0.5) + 0.12 * np.sin(40 * (u + 0.02 * at(wood, u * 0.1, v, 1.0))))[..., None]
    )
    planks[(v * 7) % 1 < 0.035] *= 0.35
    planks *= (1 + 0.12 * rng.normal(size=7))[(v * 7).astype(int).clip(0, 6)][..., None]
    top = np.vstack([[0, 0, 0.8], rim / [1.7, 1.7, 1] * [0.85, 0.85, 0] + [0, 0, 0.8]])
    shapes.append(shape(top, top[:, :2] / 1.7 + 0.5, fan, as_texture(planks), np.tile([0, 0, 1.0], (97, 1)), 1.0))
    shapes.append(revolved([(0.3, 0.72), (0.85, 0.73), (0.85, 0.8)], (0, 0, 0), as_texture(planks[:64])))
    leg = smooth_profile([(0.36, 0.03), (0.34, 0.09), (0.12, 0.16), (0.09, 0.32), (0.13, 0.46), (0.08, 0.6), (0.2, 0.72)], 48)
    shapes.append(revolved(leg, (0, 0, 0), as_texture(planks[:, :256])))
    vase = np.array([(0.12, 0.0), (0.16, 0.02), (0.22, 0.12), (0.235, 0.26), (0.19, 0.38), (0.12, 0.45), (0.15, 0.52)])
    shapes.append(revolved(smooth_profile(vase), (-0.2, 0.12, 0.8), vase_texture(rng, 1536, 768), 1.0, 96))
    shapes.append(revolved([(0.13, 0.49), (0.06, 0.49), (0.001, 0.49)], (-0.2, 0.12, 0.8), flat((44, 30, 20))))
    positions, uvs, triangles, normals = sphere(np.array((0.34, -0.28, 0.96)), 0.16)
    shapes.append(shape(positions, uvs, triangles, globe_texture(rng), normals, 1.0))
    plate = [(0.001, 0.012), (0.14, 0.012), (0.22, 0.04), (0.225, 0.05)]
    shapes.append(revolved(plate, (0.3, 0.38, 0.8), as_texture(vase_texture(rng, 512, 128)), 1.0))
    for i, fruit in enumerate([(206, 60, 40), (226, 150, 40), (120, 150, 50), (196, 70, 60)]):
        positions, uvs, triangles, normals = sphere(
            np.array((0.3 + 0.075 * np.cos(1.6 * i), 0.38 + 0.075 * np.sin(1.6 * i), 0.87)), 0.06, 32
        )
        speckled = as_texture(np.array(fruit, float) * (1 + 0.12 * tile_noise(rng, 64, 0.6))[..., None])
        shapes.append(shape(positions, uvs, triangles, speckled, normals, 1.0))
    stems = np.repeat([[-0.2, 0.12, 1.28]], 160, 0) + rng.normal(size=(160, 3)) * [0.035, 0.035, 0]
    shapes.append(
        plant(
            strips(
                stems,
                rng.normal(size=(160, 3)) * [0.5, 0.5, 0] + [0, 0, 1],
                rng.uniform(0.2, 0.45, 160),
                rng.uniform(0.014, 0.03, 160),
                rng.uniform(0.3, 1.8, 160),
                leaf,
                rng,
            ),
            gradient((34, 80, 40), (150, 190, 90), rng)
        )
    )

    # Grass on the lawn near the cameras' ring, bushes beside the terrace.
    for turn in np.linspace(0, 2 * np.pi, 13)[:-1]:
        r = rng.uniform(1.9, 2.9)
        shapes.append(grass((r * np.cos(turn), r * np.sin(turn), 0), rng.uniform(0.25, 0.5), 420, 0.26, 0.016, rng))
    shapes.append(grass((0, 0, 0), 9.0, 9000, 0.1, 0.02, rng, (52, 78, 30), (134, 156, 70)))
    shapes.append(bush((-1.7, -1.55, 0), (0.55, 0.5, 0.75), rng))
    shapes.append(bush((5.2, 3.2, 0), (1.1, 0.9, 1.3), rng, 3000, 0.15, (50, 46, 30), (190, 120, 110)))
    shapes.append(bush((-6.0, 4.2, 0), (1.3, 1.5, 1.2), rng, 3000, 0.16))

    # A fence with gaps, a ladder against nothing thicker than its rungs.
    planks, rails = [], []
    for turn in np.arange(0, 2 * np.pi, 0.034):
        if 1.3 < turn < 1.75 or 4.0 < turn < 5.0:
            continue
        r = 13 + 1.2 * np.sin(3 * turn)
        spot = np.array([r * np.cos(turn), r * np.sin(turn), 0])
        planks.append(box_part(spot, (0.04, 0.16, 1.15 + rng.uniform(-0.08, 0.08)), turn))
        ahead = turn + 0.034
        end = np.array([np.cos(ahead), np.sin(ahead), 0]) * (13 + 1.2 * np.sin(3 * ahead))
        rails += [tube_part([spot + [0, 0, z], end + [0, 0, z]], 0.035, 4) for z in (0.4, 0.9)]
    shapes.append(joined(planks + rails, bark(rng)))

    for spot, height, leaves in [
        ((9.5, -4.5), 6.5, 4200),
        ((-9, 9.0), 7.5, 4200),
        ((3.5, 17.0), 8.5, 4000),
        ((-18, -3.0), 9.0, 4000),
        ((17, 9.0), 9.0, 4000),
        ((-7, -14.0), 7.0, 4200),
        ((30, -14.0), 11.0, 3500),
        ((-26, 22.0), 12.0, 3500),
        ((12, 38.0), 12.0, 3000),
        ((-44, -20.0), 13.0, 3000),
        ((22, -38.0), 12.0, 3000),
    ]:
        autumn = rng.uniform() < 0.3
        shapes += tree(
            (*spot, 0),
            height,
            rng,
            leaves,
            0.034 * height,
            *(((110, 60, 24), (222, 160, 60)) if autumn else ((28, 58, 20), (118, 150, 58)))
        )
    far = []
    for _ in range(130):  # copses and single trees in the fields
        turn, r = rng.uniform(0, 2 * np.pi), rng.uniform(75, 330)
        height = rng.uniform(7, 14)
        out = directions_on_sphere(60, rng)
        roots = np.array([r * np.cos(turn), r * np.sin(turn), height * 0.55]) + out * height * [0.33, 0.33, 0.42]
        far.append(
            strips(
                roots,
                out + rng.normal(size=out.shape),
                np.full(60, height * 0.3),
                np.full(60, height * 0.26),
                np.full(60, 0.4),
                leaf,
                rng,
                2,
            )
        )
    shapes.append(plant(merged(far), gradient((36, 62, 34), (110, 134, 74), rng)))

    walls = [(226, 206, 170), (196, 150, 128), (214, 220, 214), (168, 86, 68), (232, 196, 140), (202, 190, 170)]
    for i, (spot, size, turn) in enumerate(
        [
            ((20, -6), (9, 7, 5.6), 1.4),
            ((-15, 17), (10, 7, 5.4), 0.6),
            ((-6, -26), (12, 8, 6.0), 0.1),
            ((33, 20), (10, 8, 5.8), 2.2),
            ((-34, 4), (11, 8, 5.6), 1.6),
            ((6, 55), (14, 9, 6.2), 0.0),
        ]
    ):
        shapes += house(
            (*spot, 0), size, turn, rng, walls[i], 2, 3 + i % 2, brick=i in (3, 5), roof=[(150, 74, 50), (92, 88, 92), (168, 98, 60)][i % 3]
        )
    shapes += tower((-70, 62, 0), rng)
    shapes.append(hills(rng, 330, 1500, 150, FIELDS))

    poses = []
    for i in range(VIEWS):
        jitter = np.random.default_rng(seed * 1000 + i)
        turn = 2 * np.pi * i / VIEWS + jitter.uniform(-0.04, 0.04)
        height = (1.25, 1.65, 2.1)[i % 3] + jitter.uniform(-0.08, 0.08)
        r = 3.0 * jitter.uniform(0.93, 1.07)
        # Low cameras look horizontally, so that distant objects fill the upper half of their pictures.
        target = (jitter.uniform(-0.15, 0.15), jitter.uniform(-0.15, 0.15), (1.15, 1.05, 1.0)[i % 3])
        poses.append(look((r * np.cos(turn), r * np.sin(turn), height), target))
    return dict(shapes=shapes, sky=sky(rng), sun=(0.45, 0.35, -0.82), poses=poses, camera=CAMERA)
