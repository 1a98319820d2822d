"""Surroundings of the unbounded scenes: fields, hills, a sky. Lengths in metres, z is up."""

import numpy as np

from procedural import as_texture, grid_triangles, shape
from unbounded_parts import at, mixed, tile_noise

HAZE = (176, 194, 214)
FIELDS = [(126, 146, 74), (168, 164, 88), (104, 132, 70), (146, 126, 84), (190, 178, 110), (92, 122, 62)]


def meadow(rng):
    """Colour of the ground at x, y: lawn and worn earth, farther out fields of several crops, and finally haze."""
    fine, middle, coarse, parcels = (tile_noise(rng, 512, f) for f in (0.3, 0.8, 1.1, 1.2))

    def colour(x, y):
        r = np.hypot(x, y)
        blades, spots, large = at(fine, x, y, 3.1) + at(fine, y, x, 13.7), at(middle, x, y, 17.0), at(coarse, x, y, 140.0)
        image = mixed((70, 98, 40), (134, 150, 70), 0.45 + 0.16 * blades + 0.14 * spots + 0.12 * large)
        worn = np.clip(2.5 * (spots + 0.5 * large - 1.15), 0, 1)
        image = image * (1 - worn[..., None]) + worn[..., None] * mixed((112, 90, 62), (168, 144, 104), 0.5 + 0.3 * blades)
        path = np.abs(y - 5.5 - 3 * np.sin(x / 9)) < 0.8 + 0.1 * spots
        image[path] = mixed((140, 122, 96), (206, 192, 164), 0.5 + 0.32 * blades)[path]
        crop = np.array(FIELDS, float)[np.floor(3 * at(parcels, x, y, 900.0) + 9).astype(int) % len(FIELDS)]
        furrows = 1 + 0.07 * np.sin(x * 1.3 + 3 * np.floor(at(parcels, y, x, 900.0)) * y) * (r < 250) + 0.05 * large + 0.05 * spots
        image = np.where((r > 62 + 8 * large)[..., None], crop * furrows[..., None], image)
        return mixed(image, HAZE, 1 - np.exp(-r / 1800.0))

    return colour


def hills(rng, near, far, height, colours, haze=(176, 194, 214), thickness=2500.0, segments=384, rows=24):
    """A ring of hills about the origin; fields and woods by slope and noise, paler with distance."""
    angle, s = np.linspace(0, 2 * np.pi, segments + 1), np.linspace(0, 1, rows)
    a, t = np.meshgrid(angle, s)
    r = near + (far - near) * t
    ridge, bump = tile_noise(rng, 256, 1.4), tile_noise(rng, 256, 1.6)
    # As a function of the angle, so that the ring closes.
    profile = 0.55 + 0.22 * at(ridge, a, 0 * a + 1.3, 2 * np.pi)
    z = height * np.clip(
        np.sin(np.pi * 0.5 * t) ** 1.3 * np.clip(profile, 0.12, None) + 0.06 * t * at(bump, r * np.cos(a), r * np.sin(a), 900.0), 0, None
    )
    positions = np.stack([r * np.cos(a), r * np.sin(a), z - 0.5 * (1 - t)], -1).reshape(-1, 3)
    uvs = np.stack([a / (2 * np.pi), t], -1).reshape(-1, 2)
    ta, tt = np.meshgrid((np.arange(4096) + 0.5) / 4096 * 2 * np.pi, 1 - (np.arange(192) + 0.5) / 192)
    tr = near + (far - near) * tt
    x, y = tr * np.cos(ta), tr * np.sin(ta)
    patches = np.floor(3 * at(tile_noise(rng, 512, 1.2), x, y, 1500.0) + 8).astype(int) % len(colours)
    image = np.array(colours, float)[patches]
    woods = at(tile_noise(rng, 512, 0.9), x, y, 700.0)
    image[woods > 0.25] = (48, 72, 44)
    image *= (1 + 0.16 * at(tile_noise(rng, 512, 0.5), x, y, 260.0))[..., None]
    return shape(positions, uvs, grid_triangles(rows, segments + 1), as_texture(mixed(image, haze, 1 - np.exp(-tr / thickness))))


def sky(rng, size=(512, 1024), cover=0.15):
    """Radiance [H, W, 3] of a blue sky with clouds, equirectangular, row 0 at the zenith; nearly black below."""
    elevation = np.pi / 2 - np.pi * (np.arange(size[0]) + 0.5) / size[0]
    azimuth = 2 * np.pi * (np.arange(size[1]) + 0.5) / size[1]
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    up = np.clip(np.sin(e), 0, 1)
    blue = mixed((0.70, 0.80, 0.90), (0.16, 0.34, 0.72), up**0.55)
    # Clouds lie on a plane above, so that they shrink towards the horizon.
    x, y = np.cos(a) * np.cos(e) / (up + 0.12), np.sin(a) * np.cos(e) / (up + 0.12)
    field = at(tile_noise(rng, 512, 1.25), x, y, 9.0) + 0.25 * at(tile_noise(rng, 512, 1.0), x, y, 2.5)
    cloud = np.clip((field - cover) * 1.1, 0, 1) * np.clip(up * 14, 0, 1)
    shade = mixed((0.98, 0.97, 0.95), (0.62, 0.65, 0.70), (field - cover) * 0.55 - 0.3)
    picture = blue * (1 - cloud[..., None]) + shade * cloud[..., None]
    picture[e < -0.02] = 0.02  # behind the ground; samples there are wasted
    return picture.astype(np.float32)
