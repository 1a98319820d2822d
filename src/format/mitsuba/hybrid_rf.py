"""Renders what `centaur convert SCENE scene.xml` wrote, in Mitsuba 3 (3.9 or later).

    python3 hybrid_rf.py scene.xml -o picture.exr [--camera NAME|0] [--output linear|blending] [--sh-direction mean|ray]

or, in a program of one's own, once a variant is set (`llvm_ad_rgb` or `cuda_ad_rgb`):

    import mitsuba as mi; mi.set_variant('llvm_ad_rgb')
    import hybrid_rf; hybrid_rf.register()
    image = mi.render(mi.load_file('scene.xml', parallel=False), sensor=0)

It registers four plug-ins:

* the integrator `hybrid_rf`, Centaur's image model `ray`: splats (`ellipsoidsmesh`, best twice, with two extents) have the response of their peak along the
  exact ray of a pixel, meshes (with the BSDF `hybrid_maps`) that of their maps where the ray meets them, and all are blended in
  the order of depth along that ray. There are no lights: colours are what was captured.
* the BSDF `hybrid_maps`: maps of SH coefficients and logits of opacity, filtered trilinearly before they are made colour and
  opacity.
* the sensor `hybrid_pinhole`: any focal lengths and principal point, in pixels. Its `to_world` is as that of `perspective`: the
  camera looks along +z, +x is left and +y up. Its rays have depth 1 at parameter 1, so that depths are along the view's axis.
* the sampler `pixel_center`.

Blending is in the space that the scene was trained in, as a rule sRGB-encoded values, as browsers and 3DGS do, not in linear
light, as Mitsuba does elsewhere.
"""

import argparse
import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree


LLVM_FOLDERS = ['/usr/lib', '/usr/lib64', '/usr/local/lib', '/opt/homebrew/opt', '/usr/local/opt']


def is_as_wide(path):
    """Whether a library is of this Python's width, as those of 32 bits, which may stand first, are not. macOS has no others."""
    if sys.platform == 'darwin':
        return True
    try:
        with open(path, 'rb') as file:
            return file.read(5) == b'\x7fELF' + (b'\2' if sys.maxsize > 2**32 else b'\1')
    except OSError:
        return False


def find_llvm(folders=LLVM_FOLDERS):
    """Dr.Jit takes the first LLVM that it finds, and dies of those before 17 on some machines. 19 is the one tested."""
    patterns = ['libLLVM*.so*', '*/libLLVM*.so*', 'llvm*/lib/libLLVM*.so*', 'llvm*/lib/libLLVM.dylib']
    found = {}
    for path in (p for folder in folders for pattern in patterns for p in Path(folder).glob(pattern)):
        version = re.search(r'LLVM(?:-|\.so\.)(\d+)', path.name) or re.search(r'llvm[@-]?(\d+)', str(path))
        if version and int(version[1]) >= 17 and is_as_wide(path):
            found.setdefault(int(version[1]), str(path))
    return found[min(found, key=lambda version: abs(version - 19))] if found else None


def parse():
    parser = argparse.ArgumentParser(description='Render a scene of `centaur convert` in Mitsuba.')
    parser.add_argument('scene', type=Path, help='the .xml')
    parser.add_argument('-o', '--out', type=Path, required=True, help='the .exr to write: RGBA, layers, depth')
    parser.add_argument('--camera', default='0', help='name of a camera, or its number (default: 0)')
    parser.add_argument('--output', choices=['linear', 'blending'], help='what RGB is (default: as in the .xml)')
    parser.add_argument('--sh-direction', choices=['mean', 'ray'], help='where splats are seen from (default: as in the .xml)')
    return parser.parse_args()


# What is asked for is told, and wrong arguments are, without the packages that rendering takes.
ARGUMENTS = parse() if __name__ == '__main__' else None

if 'DRJIT_LIBLLVM_PATH' not in os.environ and sys.platform != 'win32' and (llvm := find_llvm()):
    os.environ['DRJIT_LIBLLVM_PATH'] = llvm

try:
    import drjit as dr
    import mitsuba as mi
    import numpy as np
except ImportError as error:
    sys.exit(f'hybrid_rf.py: {error}; install it with: python3 -m venv venv && venv/bin/pip install mitsuba==3.9.1 numpy')


def find_variant():
    """LLVM if it is one of those that `find_llvm` or the user chose, else CUDA, else the LLVM that Dr.Jit finds, which may be an old
    one; None where there is nothing. On Windows and macOS any LLVM comes before CUDA."""
    if 'DRJIT_LIBLLVM_PATH' in os.environ:
        return 'llvm_ad_rgb'
    backends = [('cuda_ad_rgb', dr.JitBackend.CUDA), ('llvm_ad_rgb', dr.JitBackend.LLVM)]
    if sys.platform in ('win32', 'darwin'):
        backends.reverse()
    return next((variant for variant, backend in backends if dr.has_backend(backend)), None)


if mi.variant() is None:
    if (variant := find_variant()) is None:
        sys.exit('hybrid_rf.py: needs LLVM (apt install libllvm19; elsewhere its library in DRJIT_LIBLLVM_PATH) or an NVIDIA GPU')
    mi.set_variant(variant)

# Largest opacity of a splat and of a surface, and the least that a splat contributes with.
MAX_SPLAT_ALPHA, MAX_SURFACE_ALPHA, MIN_SPLAT_ALPHA = 0.99, 1 - 1e-4, 1 / 255
# How far behind an entered shell or a met surface the search goes on, relative to the distance: the least step that a
# float of 32 bits can make. Shells that begin within it of each other are lost, which is why splats have two.
STEP = 1.3e-7
# A surface that a ray meets within this distance of itself, relative to it, is two triangles at their common edge.
EDGE = 1e-5
# Slots of the rays that need the most, 24 KB of memory each ray.
MOST_SLOTS = 1024
# In the place of a splat's number.
SURFACE = 0xFFFFFFFF
# Farthest point of the icosahedron around a unit sphere that `ellipsoidsmesh` makes of a splat.
SHELL = 1.26


class HybridMaps(mi.BSDF):
    """Maps of a mesh: the files `map_00` (R, G, B of SH coefficient 0, logit of opacity in A) to `map_15` (R, G, B)."""

    def __init__(self, props):
        super().__init__(props)
        self.m_components = [mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
        self.m_flags = self.m_components[0]
        names = [f'map_{k:02}' for k in range(16) if f'map_{k:02}' in props]
        maps = [self.load(props[name], 3 if i else 4) for i, name in enumerate(names)]
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[len(maps)]
        self.base = self.levels(maps[0])
        self.bands = self.levels(np.concatenate([m[..., :3] for m in maps[1:]], axis=-1)) if len(maps) > 1 else []

    @staticmethod
    def load(name, channels):
        try:
            texels = np.array(mi.Bitmap(str(mi.file_resolver().resolve(name)))).astype(np.float32)
        except RuntimeError as error:
            raise RuntimeError(f'{name}: cannot read ({last_line(error)})') from None
        if texels.ndim != 3 or texels.shape[2] < channels:
            raise RuntimeError(f'{name}: expected {channels} channels, found those of another picture')
        return texels

    @staticmethod
    def levels(texels):
        """A texture per mip level: halving while both sides are even, at most four times."""
        levels = [texels]
        while len(levels) < 5 and levels[-1].shape[0] % 2 == 0 and levels[-1].shape[1] % 2 == 0:
            t = levels[-1]
            levels.append((t[::2, ::2] + t[1::2, ::2] + t[::2, 1::2] + t[1::2, 1::2]) / 4)
        # Filtering in hardware rounds weights to 8 bits.
        modes = {'use_accel': False, 'filter_mode': dr.FilterMode.Linear, 'wrap_mode': dr.WrapMode.Clamp}
        return [mi.Texture2f(mi.TensorXf(np.ascontiguousarray(t)), **modes) for t in levels]

    @staticmethod
    def filtered(levels, uv, duv_dx, duv_dy, active):
        """Trilinear: the level is log2 of the longer axis of the pixel's footprint, in texels."""
        size = mi.Vector2f(levels[0].shape[1], levels[0].shape[0])
        x, y = duv_dx * size, duv_dy * size
        a, b, c = dr.squared_norm(x), dr.squared_norm(y), dr.dot(x, y)
        longest = 0.5 * (a + b) + dr.sqrt(0.25 * dr.square(a - b) + dr.square(c))
        level = dr.clip(0.5 * dr.log2(dr.maximum(longest, 1e-30)), 0, len(levels) - 1)
        values = [mi.Float(0)] * levels[0].shape[2]
        for i, texture in enumerate(levels):
            weight = dr.maximum(1 - dr.abs(level - i), 0)
            values = [v + weight * t for v, t in zip(values, texture.eval(uv, active & (weight > 0)))]
        return values

    def radiance(self, si, direction, duv, active):
        """Colour towards the viewer who looks along `direction`, and opacity. `duv`: how UV changes per pixel, to the right and
        down; the finest level is taken where it is 0."""
        base = self.filtered(self.base, si.uv, *duv, active)
        coefficients = [*base[:3], *(self.filtered(self.bands, si.uv, *duv, active) if self.bands else [])]
        alpha = dr.minimum(dr.rcp(1 + dr.exp(-base[3])), MAX_SURFACE_ALPHA)
        return sh_color(coefficients, dr.normalize(direction), self.degree), alpha

    def eval_null_transmission(self, si, active=True):
        return mi.Spectrum(1 - self.radiance(si, -si.to_world(si.wi), [mi.Vector2f(0)] * 2, active)[1])

    def to_string(self):
        return f'HybridMaps[degree = {self.degree}]'


def sh_color(coefficients, direction, degree):
    color = mi.Color3f(0.5)
    for k, basis in enumerate(dr.sh_eval(direction, degree)):
        color += basis * mi.Color3f(coefficients[3 * k], coefficients[3 * k + 1], coefficients[3 * k + 2])
    return dr.maximum(color, 0)


def last_line(error):
    """Of what Mitsuba says of an error, in many lines, the one that names it."""
    return str(error).strip().splitlines()[-1].strip().removeprefix('RuntimeError: ')


def gradients(shape, si, active):
    """Gradients of u and of v along the surface that is met, and its normal."""
    edge, other, step, other_step = si.dp_du, si.dp_dv, mi.Vector2f(1, 0), mi.Vector2f(0, 1)
    if isinstance(shape, mi.Mesh) and shape.has_vertex_texcoords():
        # Of a triangle without area in UV, as those of a palette of colours are, what Mitsuba gives is an arbitrary basis.
        corners = shape.face_indices(si.prim_index, active)
        (p, edge, other), (uv, step, other_step) = (
            [of(corner, active) for corner in (corners.x, corners.y, corners.z)] for of in (shape.vertex_position, shape.vertex_texcoord)
        )
        edge, other, step, other_step = mi.Vector3f(edge - p), mi.Vector3f(other - p), mi.Vector2f(step - uv), mi.Vector2f(other_step - uv)
    normal = dr.cross(edge, other)
    inverse = dr.select(dr.norm(normal) > 0, dr.rcp(dr.norm(normal)), 0)
    normal *= inverse
    # gradient · edge = step, gradient · other = other_step, gradient · normal = 0
    a, b = dr.cross(other, normal) * inverse, dr.cross(normal, edge) * inverse
    return step.x * a + other_step.x * b, step.y * a + other_step.y * b, normal


def uv_change(si, direction, step, gradient_u, gradient_v, normal):
    """Change of UV where the surface is met, per `step` of the ray's direction; `si.t` is along `direction`, from the camera."""
    move = si.t * (step - direction * (dr.dot(normal, step) / dr.dot(normal, direction)))
    change = mi.Vector2f(dr.dot(gradient_u, move), dr.dot(gradient_v, move))
    return dr.select(dr.isfinite(change), change, 0)


class HybridPinhole(mi.Sensor):
    """`focal_x`, `focal_y`, `center_x`, `center_y` in pixels from the top left corner; pixel centres are at +0.5."""

    def __init__(self, props):
        super().__init__(props)
        self.pose = np.array(props['to_world'].matrix, dtype=float).reshape(4, 4)
        self.focal = [props['focal_x'], props['focal_y']]
        self.center = [props['center_x'], props['center_y']]
        self.label = props.get('label', '')

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        film = self.film()
        x, y = (sample2[i] * film.crop_size()[i] + film.crop_offset()[i] for i in range(2))
        local = mi.Vector3f((self.center[0] - x) / self.focal[0], (self.center[1] - y) / self.focal[1], 1)
        direction = mi.Matrix3f(self.pose[:3, :3].tolist()) @ local
        return mi.Ray3f(mi.Point3f(self.pose[:3, 3].tolist()), direction, time, mi.Color0f()), mi.Color3f(1)

    def per_pixel(self):
        """What is added to the direction of a ray from one pixel to the next, to the right and down."""
        return [(-self.pose[:3, axis] / self.focal[axis]).tolist() for axis in range(2)]

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self):
        return f'HybridPinhole[{self.label}, focal = {self.focal}, center = {self.center}]'


class PixelCenter(mi.Sampler):
    def next_1d(self, active=True):
        return mi.Float(0.5)

    def next_2d(self, active=True):
        return mi.Point2f(0.5)

    def fork(self):
        return PixelCenter(mi.Properties())

    def clone(self):
        return PixelCenter(mi.Properties())


class HybridRF(mi.SamplingIntegrator):
    """Parameters: `near` (depth beyond which means, peaks and surfaces count), `surfaces` (mesh fragments that count per ray, nearest first),
    `background` (RGB in the space of blending), `color_space` (`srgb` or `linear`: the space of blending), `sh_direction`
    (`mean`: from the camera to a splat's mean, or `ray`), `slots` (splats whose shells a ray is in at once; rays for which they
    are too few are traced again with four times as many, up to 1024 or to `slots`), `aovs`, and `output`, what the film's RGB is:

    * `linear`: linear light of the colour over the background, as Mitsuba and other programs expect of an EXR;
    * `blending`: values in the space of blending, multiplied by alpha, without background.

    A is what the scene covers. AOVs are in the space of blending and multiplied by alpha: `splats.RGBA`, `mesh.RGBA` (each with
    what the other hides of it left out, so that both sum to the picture), `Z` (mean depth along the view's axis; 1e10 where
    there is nothing).
    """

    def __init__(self, props):
        super().__init__(props)
        self.near = props.get('near', 0.2)
        self.surfaces = props.get('surfaces', 1)
        self.background = mi.ScalarColor3f(props.get('background', mi.ScalarColor3f(0)))
        self.encoded = props.get('color_space', 'srgb') == 'srgb'
        self.by_mean = props.get('sh_direction', 'mean') == 'mean'
        self.linear = props.get('output', 'linear') == 'linear'
        self.slots = props.get('slots', 64)
        self.aovs = props.get('aovs', True)
        # Of the camera: how far behind it rays begin, where it looks, and how rays change per pixel, to the right and
        # down.
        self.back, self.forward, self.pixel = 0.0, None, None
        # Of a splat, the next of those in its place, in a ring; None where each is alone.
        self.twins = None

    def aov_names(self):
        if not self.aovs:
            return []
        return [f'{layer}.{c}' for layer in ('splats', 'mesh') for c in 'RGBA'] + ['Z']

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """As every integrator's, but with the alpha that was summed; `sample` can only say 0 or 1."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        film, sampler = sensor.film(), sensor.sampler()
        pose = np.array(sensor.world_transform().matrix).reshape(4, 4)
        self.back = self.reach_behind(scene, pose[:3, 3])
        self.twins = self.rings(scene, pose[:3, 3])
        self.forward = (pose[:3, 2] / np.linalg.norm(pose[:3, 2])).tolist()
        self.pixel = sensor.per_pixel() if isinstance(sensor, HybridPinhole) else None
        film.prepare(self.aov_names())
        width, height = film.crop_size()
        index = dr.arange(mi.UInt32, width * height)
        corner = mi.Vector2f(index % width, index // width)
        samples = int(spp or sampler.sample_count())
        short = 0
        for i in range(samples):
            sampler.seed(int(seed) * samples + i, width * height)
            position = corner + sampler.next_2d()
            relative = position / mi.Vector2f(width, height)
            ray, _ = sensor.sample_ray_differential(sampler.next_1d(), sampler.next_1d(), relative, sampler.next_2d())
            rgb, alpha, aovs, missed = self.trace_all(scene, ray)
            short += missed
            block = film.create_block()
            block.put(position + mi.Vector2f(film.crop_offset()), [*rgb, alpha, mi.Float(1), *aovs][: block.channel_count()])
            dr.eval(block.tensor())
            film.put_block(block)
        if short:
            slots = max(self.slots, MOST_SLOTS)
            print(
                f'hybrid_rf.py: {short} of {samples * width * height} rays are in more splats at once than the {slots} slots hold, and may lack '
                f'some or have them out of order; <integer name="slots" value="{4 * slots}"/> in the <integrator> makes room',
                file=sys.stderr,
            )
        if not develop:
            return mi.TensorXf()
        return film.develop()

    @staticmethod
    def rings(scene, eye):
        """Shells that a ray enters within a rounding error of each other are met once, not twice; so it is with the clones that
        density control leaves in one place. Whoever lies in one cell of a ten-thousandth of the distance is taken for one;
        to be looked at without need costs nothing but time."""
        clouds = [np.array(mi.traverse(s)['data']).reshape(-1, 10) for s in scene.shapes() if s.is_ellipsoids()]
        if not clouds or not all(np.array_equal(clouds[0], cloud) for cloud in clouds[1:]):
            return None
        centers = clouds[0][:, :3].astype(np.float64)
        cell = 1e-4 * np.median(np.linalg.norm(centers - eye, axis=1)) + 1e-30
        group = np.arange(len(centers))
        # The second grid is for those that a wall of the first comes between.
        for shift in (0, 0.5, 0, 0.5):
            x, y, z = np.floor(centers / cell + shift).astype(np.int64).T
            _, inside = np.unique((x * 73856093) ^ (y * 19349663) ^ (z * 83492791), return_inverse=True)
            least = np.full(inside.max() + 1, len(group))
            np.minimum.at(least, inside, group)
            group = least[inside]
        order = np.argsort(group, kind='stable')
        ends = np.append(np.diff(group[order]) != 0, True)
        begins = np.append(True, ends[:-1])
        if begins.all():
            return None
        after = np.roll(order, -1)
        after[ends] = order[begins]
        ring = np.empty(len(order), np.uint32)
        ring[order] = after
        return mi.UInt32(ring)

    def reach_behind(self, scene, eye):
        """How far behind the camera rays must begin to enter all shells that it is in. Back faces of shells are not met."""
        reach = 0.0
        for shape in (s for s in scene.shapes() if s.is_ellipsoids()):
            parameters = mi.traverse(shape)
            center, scale, xyzw = np.split(np.array(parameters['data']).reshape(-1, 10), [3, 6], axis=1)
            x, y, z, w = xyzw.T
            axes = np.stack([
                1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
            ], -1).reshape(-1, 3, 3)  # fmt: skip
            offset, radius = eye - center, SHELL * parameters['extent']
            inside = np.linalg.norm(np.einsum('nji,nj->ni', axes, offset) / scale, axis=1) <= radius
            reaches = np.linalg.norm(offset, axis=1) + radius * scale.max(axis=1)
            reach = max(reach, reaches[inside].max(initial=0.0))
        return float(reach)

    def trace_all(self, scene, ray):
        """As `trace`, but rays that lack slots are traced again with more. -> RGB, alpha, AOVs, and how many rays lack them still"""
        slots = self.slots
        *image, is_short = self.trace(scene, ray, slots)
        dr.eval(image, is_short)
        while dr.any(is_short) and slots < MOST_SLOTS:
            slots = min(4 * slots, MOST_SLOTS)
            *again, still = self.trace(scene, ray, slots, is_short)
            image = dr.select(is_short, again, image)
            is_short &= still
            dr.eval(image, is_short)
        return *image, int(dr.count(is_short)[0])

    def sample(self, scene, sampler, ray, medium=None, active=True):
        rgb, alpha, aovs, _ = self.trace(scene, ray, self.slots, active)
        return mi.Spectrum(rgb), alpha > 0, aovs

    def splat(self, si, origin, direction, active):
        """Of the splat whose shell is entered at `si`: depth of its peak, opacity and colour along the ray."""

        def of(shape, si, origin, direction, active):
            if shape is None or not shape.is_ellipsoids():
                return mi.Float(0), mi.Float(0), mi.Color3f(0)
            e = shape.eval_attribute_x('ellipsoid', si, active)
            mean, scale = mi.Point3f(e[0], e[1], e[2]), mi.Vector3f(e[3], e[4], e[5])
            turn = dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(e[6], e[7], e[8], e[9])).T
            o, d = (turn @ (origin - mean)) / scale, (turn @ direction) / scale
            peak = -dr.dot(o, d) / dr.dot(d, d)
            response = dr.exp(-0.5 * dr.squared_norm(dr.fma(d, peak, o)))
            alpha = shape.eval_attribute_1('opacities', si, active) * response
            is_there = (alpha >= MIN_SPLAT_ALPHA) & (peak > self.near)
            if self.forward:
                # As rasterisers do, which project means.
                is_there &= dr.dot(mean - origin, mi.Vector3f(self.forward)) > self.near
            alpha = dr.select(is_there, dr.minimum(alpha, MAX_SPLAT_ALPHA), 0)
            sh = shape.eval_attribute_x('sh_coeffs', si, active)
            towards = dr.normalize(mean - origin if self.by_mean else direction)
            return peak, alpha, sh_color(sh, towards, int(round((len(sh) // 3) ** 0.5)) - 1)

        return dr.dispatch(si.shape, of, si, origin, direction, active)

    def surface(self, si, direction, active):
        """Of the mesh that is met at `si`: opacity and colour."""
        duv = [mi.Vector2f(0)] * 2
        if self.pixel:
            plane = dr.dispatch(si.shape, gradients, si, active)
            duv = [uv_change(si, direction, mi.Vector3f(step), *plane) for step in self.pixel]

        def of(bsdf, si, direction, duv, active):
            if not isinstance(bsdf, HybridMaps):
                return mi.Float(0), mi.Color3f(0)
            color, alpha = bsdf.radiance(si, direction, duv, active)
            return alpha, color

        return dr.dispatch(si.bsdf(), of, si, direction, duv, active)

    @dr.syntax
    def trace(self, scene, ray, slots, active=True):
        """Shells are entered in order of depth, and peaks lie behind entries: what waits in the slots is blended as soon as
        the next entry is behind its peak. -> RGB, alpha, AOVs, and whether slots were lacking"""
        origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        depths, alphas = dr.alloc_local(mi.Float, slots, mi.Float(dr.inf)), dr.alloc_local(mi.Float, slots)
        reds, greens, blues = dr.alloc_local(mi.Float, slots), dr.alloc_local(mi.Float, slots), dr.alloc_local(mi.Float, slots)
        # Number of the splat, or SURFACE.
        names = dr.alloc_local(mi.UInt32, slots)
        # How many slots are taken, beyond which none is, and the least depth in them.
        waiting, top, nearest = mi.UInt32(0), mi.UInt32(0), mi.Float(dr.inf)
        # What was blended last, and whether it had to make room.
        blended, blended_name, is_short = mi.Float(-dr.inf), mi.UInt32(0), mi.Bool(False)

        start = mi.Float(-self.back)
        last_shape, last_depth = dr.zeros(mi.ShapePtr), mi.Float(-dr.inf)
        met, twin = mi.UInt32(0), mi.UInt32(SURFACE)
        transmittance, depth = mi.Float(1), mi.Float(0)
        splats, surfaces, splats_alpha, surfaces_alpha = mi.Color3f(0), mi.Color3f(0), mi.Float(0), mi.Float(0)
        active = mi.Bool(active)
        while dr.hint(active, label='hybrid_rf'):
            si = scene.ray_intersect(
                mi.Ray3f(dr.fma(direction, start, origin), direction), ray_flags=mi.RayFlags.All, coherent=False, active=active
            )
            valid = si.is_valid()
            here = dr.select(valid, start + si.t, dr.inf)
            is_splat = valid & si.shape.is_ellipsoids()
            is_surface = valid & ~si.shape.is_ellipsoids()
            entered = mi.UInt32(si.prim_index)
            if dr.hint(self.twins is not None, mode='scalar'):
                # The same ray once more for every twin.
                si.prim_index = dr.select(twin != SURFACE, twin, entered)
                after = dr.gather(mi.UInt32, self.twins, si.prim_index, is_splat)
                twin = dr.select(is_splat & (after != entered), after, mi.UInt32(SURFACE))
            peak, alpha, color = self.splat(si, origin, direction, is_splat)
            met_at = mi.SurfaceInteraction3f(si)
            met_at.t = here
            surface_alpha, surface_color = self.surface(met_at, direction, is_surface)

            is_new = is_surface & (here > self.near) & ~((si.shape == last_shape) & (here - last_depth <= EDGE * here))
            is_new &= met < self.surfaces
            met += dr.select(is_new, mi.UInt32(1), mi.UInt32(0))
            last_shape, last_depth = dr.select(is_surface, si.shape, last_shape), dr.select(is_surface, here, last_depth)
            is_new |= is_splat & (alpha > 0)
            key, name = dr.select(is_splat, peak, here), dr.select(is_splat, si.prim_index, SURFACE)

            # Blend what is in front of `here`, and where all slots are taken the nearest. No array is written in the
            # block that reads it: Dr.Jit may order the two either way.
            is_full = mi.Bool(is_new & (waiting == slots))
            go = mi.Bool((nearest < here) | is_full)
            while go:
                nearest, first, i, least = mi.Float(dr.inf), mi.UInt32(0), mi.UInt32(0), mi.UInt32(SURFACE)
                while i < top:
                    # At equal depths by number, and splats in front of surfaces.
                    if (depths[i] < nearest) | ((depths[i] == nearest) & (names[i] < least)):
                        nearest, least = depths[i], names[i]
                        first = mi.UInt32(i)
                    i += 1
                go = (nearest < here) | is_full
                if go:
                    is_one = names[first] != SURFACE
                    w = transmittance * alphas[first]
                    c = w * mi.Color3f(reds[first], greens[first], blues[first])
                    splats += dr.select(is_one, c, 0)
                    surfaces += dr.select(is_one, 0, c)
                    splats_alpha += dr.select(is_one, w, 0)
                    surfaces_alpha += dr.select(is_one, 0, w)
                    depth += w * nearest
                    transmittance *= 1 - alphas[first]
                    depths[first] = mi.Float(dr.inf)
                    blended, blended_name = mi.Float(nearest), mi.UInt32(least)
                    is_short |= nearest >= here
                    waiting -= 1
                    is_full = mi.Bool(False)
                go &= waiting > 0
                if waiting == 0:
                    nearest, top = mi.Float(dr.inf), mi.UInt32(0)

            # A splat that is not behind what was blended last has been entered before, by its other shell or as a twin;
            # so has one that is waiting.
            is_new &= is_surface | (key > blended) | ((key == blended) & (name > blended_name))
            # The first slot that is free.
            slot, i = mi.UInt32(slots), mi.UInt32(0)
            while is_new & (i <= top) & (i < slots):
                if (depths[i] == dr.inf) & (slot == slots):
                    slot = mi.UInt32(i)
                if (depths[i] == key) & (names[i] == name) & is_splat:
                    is_new = mi.Bool(False)
                i += 1
            if is_new:
                depths[slot], names[slot] = key, name
                alphas[slot] = dr.select(is_splat, alpha, surface_alpha)
                color = dr.select(is_splat, color, surface_color)
                reds[slot], greens[slot], blues[slot] = color.x, color.y, color.z
                nearest = dr.minimum(nearest, key)
                top = dr.maximum(top, slot + 1)
                waiting += 1

            start = dr.select(valid & (twin == SURFACE), here + dr.maximum(STEP * dr.abs(here), 1e-9), start)
            # What is behind changes no picture of 32-bit floats.
            active &= valid & (transmittance > 1e-8)

        alpha = splats_alpha + surfaces_alpha
        rgb = splats + surfaces
        if dr.hint(self.linear, mode='scalar'):
            rgb += (1 - alpha) * mi.Color3f(self.background)
            if dr.hint(self.encoded, mode='scalar'):
                rgb = mi.math.srgb_to_linear(rgb)
        aovs = []
        if dr.hint(self.aovs, mode='scalar'):
            aovs = [
                splats.x, splats.y, splats.z, splats_alpha,
                surfaces.x, surfaces.y, surfaces.z, surfaces_alpha,
                dr.select(alpha > 0, depth / alpha, 1e10),
            ]  # fmt: skip
        return rgb, alpha, aovs, is_short

    def to_string(self):
        return 'HybridRF[]'


def register():
    """Makes the plug-ins known to Mitsuba's variant of the moment."""
    mi.register_bsdf('hybrid_maps', HybridMaps)
    mi.register_sensor('hybrid_pinhole', HybridPinhole)
    mi.register_sampler('pixel_center', PixelCenter)
    mi.register_integrator('hybrid_rf', HybridRF)


def camera_index(labels, text):
    """Index of the camera of this name, or else of this number."""
    if not labels:
        # As `centaur convert` has noted.
        raise LookupError('there are no cameras: add a <sensor> to render images')
    # In the .xml, `_` is in the place of what XML forbids and of `$`, which begins a parameter of Mitsuba.
    for name in (text, re.sub('[$\x00-\x1f\x7f-\x9f\ufffe\uffff]', '_', text)):
        if name in labels:
            return labels.index(name)
    if text.isdecimal() and len(text) < 10 and int(text) < len(labels):
        return int(text)
    some = ', '.join(f'{i} ({label})' for i, label in enumerate(labels[:8]))
    rest = f', … to {len(labels) - 1}' if len(labels) > 8 else ''
    raise LookupError(f'no camera `{text}`; there are {some}{rest}')


def files_of(document):
    """The files that an .xml refers to; none where it cannot be read, which Mitsuba says."""
    try:
        strings = ElementTree.parse(document).iter('string')
    except (OSError, ElementTree.ParseError):
        return []
    is_file = re.compile(r'filename|map_\d\d').fullmatch
    return [document.parent / string.get('value', '') for string in strings if is_file(string.get('name', ''))]


def main(arguments):
    if not arguments.scene.is_file():
        sys.exit(f'hybrid_rf.py: {arguments.scene}: no such file')
    out = arguments.out
    if out.suffix.lower() != '.exr':
        sys.exit(f'hybrid_rf.py: {out}: expected a name that ends in .exr')
    if not out.absolute().parent.is_dir():
        sys.exit(f'hybrid_rf.py: {out}: cannot write: {out.absolute().parent} is no folder')
    if out.exists() and any(file.exists() and file.samefile(out) for file in files_of(arguments.scene)):
        sys.exit(f'hybrid_rf.py: {out}: cannot write: {arguments.scene} refers to a file of this name')
    register()
    try:
        # In a thread of Mitsuba's, an error of a plug-in of ours would end the process.
        scene = mi.load_file(str(arguments.scene), parallel=False)
    except RuntimeError as error:
        sys.exit(f'hybrid_rf.py: {arguments.scene}: {last_line(error)}')
    sensors = scene.sensors()
    try:
        index = camera_index([getattr(sensor, 'label', '') for sensor in sensors], arguments.camera)
    except LookupError as error:
        sys.exit(f'hybrid_rf.py: {arguments.scene}: {error}')
    integrator = scene.integrator()
    if arguments.output:
        integrator.linear = arguments.output == 'linear'
    if arguments.sh_direction:
        integrator.by_mean = arguments.sh_direction == 'mean'
    mi.render(scene, sensor=index, integrator=integrator)
    # What is there stays until there is another.
    staged = out.with_name(f'.{out.stem}.{os.getpid()}.exr')
    try:
        sensors[index].film().bitmap().write(str(staged))
        staged.replace(out)
    except (OSError, RuntimeError) as error:
        staged.unlink(missing_ok=True)
        sys.exit(f'hybrid_rf.py: {out}: cannot write: {last_line(error)}')


if __name__ == '__main__':
    main(ARGUMENTS)
