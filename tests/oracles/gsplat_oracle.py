"""Images and gradients of gsplat's own torch reference on its garden data, as a fixture for the Rust tests.

    python gsplat_oracle.py test_garden.npz OUTPUT.safetensors [--splats 3000] [--view 0] [--seed 1]

test_garden.npz comes with gsplat (assets/). Everything is computed in float64 from inputs that are exact in float32 and
stored as F32, results as F64, row-major: means [N,3], quats [N,4] (wxyz, not normalised), log_scales [N,3],
opacity_logits [N], sh [N,16,3], viewmat [4,4] (world to camera), K [3,3], background [3], image [H,W,3], alpha [H,W],
image_gradient [H,W,3] (the given dL/dimage), and grad_<input> for each of the five inputs.

Where gsplat 1.5.3 and the INRIA rules differ, and why it does not matter here:
  alpha cap    0.999 against 0.99: opacities are at most 0.95.
  near plane   0.01 here; splats closer than 0.3 are left out, so 0.2 gives the same.
  extent       3.33 sigma per axis against the exact bound: at opacity 0.95 nothing of 1/255 or more is cut.
  T stop       both leave out the splat that would bring T to 1e-4; gsplat at <=, INRIA at <. Ties do not occur.
  order        gsplat sorts by float32 depth; the splats' depths differ by at least 4e-6 of their value.
  Jacobian     both clamp x/z at 1.3 times the field of view; gsplat per side of an off-centre principal point.
               Means outside 1.2 times the picture are left out, so no clamp is active.
  alpha < 1/255 is skipped by both; a splat on the threshold may flip in float32 (about 1/255 of its colour).
"""

import argparse
import math
import sys
import types

import numpy as np
import safetensors.numpy
import torch

torch.set_default_dtype(torch.float64)

ALPHA_CAP, ALPHA_MIN, T_STOP, TILE = 0.999, 1 / 255, 1e-4, 16
SH_C0 = 0.28209479177387814


def pairs_in_range(start, end, transmittances, means2d, conics, opacities, width, height, tile_size, offsets, flatten_ids):
    """CPU stand-in for gsplat's CUDA kernel: the contributing triples (splat, pixel, image), in blending order per
    pixel."""
    assert means2d.shape[0] == 1 and start == 0, "one image, one batch"
    centre, conic, opacity = means2d[0].detach(), conics[0].detach(), opacities[0].detach()
    first = offsets.flatten().tolist() + [len(flatten_ids)]
    columns = offsets.shape[-1]
    splats, pixels = [], []
    for tile in range(len(first) - 1):
        ids = flatten_ids[first[tile] : first[tile + 1]].long()
        y0, x0 = tile // columns * tile_size, tile % columns * tile_size
        for y in range(y0, min(y0 + tile_size, height)):
            for x in range(x0, min(x0 + tile_size, width)):
                dx, dy = x + 0.5 - centre[ids, 0], y + 0.5 - centre[ids, 1]
                a, b, c = conic[ids].unbind(-1)
                power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                alpha = (opacity[ids] * torch.exp(-power)).clamp(max=ALPHA_CAP)
                hit = ids[(power >= 0) & (alpha >= ALPHA_MIN)]
                transmittance = torch.cumprod(1 - alpha[(power >= 0) & (alpha >= ALPHA_MIN)], 0)
                live = int((transmittance > T_STOP).sum())  # decreasing, so these come first
                splats.append(hit[:live])
                pixels.append(torch.full((live,), y * width + x))
    splats, pixels = torch.cat(splats), torch.cat(pixels)
    return splats, pixels, torch.zeros_like(splats)


def weights_along_rays(alphas, ray_indices, n_rays):
    """CPU stand-in for nerfacc: alpha times the transmittance in front, per run of equal ray indices."""
    log_pass = torch.log1p(-alphas)
    before = torch.cumsum(log_pass, 0) - log_pass
    start = torch.ones_like(ray_indices, dtype=torch.bool)
    start[1:] = ray_indices[1:] != ray_indices[:-1]
    transmittance = torch.exp(before - before[start][torch.cumsum(start, 0) - 1])
    return alphas * transmittance, transmittance


def sum_along_rays(weights, values, ray_indices, n_rays):
    """CPU stand-in for nerfacc: sum of weights times values per ray."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return terms.new_zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)


def load_gsplat():
    """gsplat's torch reference, its two CUDA-only dependencies replaced."""
    import gsplat.cuda._torch_impl as reference
    import gsplat.cuda._wrapper as wrapper

    wrapper.rasterize_to_indices_in_range = pairs_in_range
    nerfacc = types.ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha, nerfacc.accumulate_along_rays = weights_along_rays, sum_along_rays
    sys.modules["nerfacc"] = nerfacc
    return reference


def render(reference, p, viewmat, K, width, height, background):
    """Image [H, W, 3] and alpha [H, W] from raw parameters; all functions except the activations are gsplat's own."""
    opacities = torch.sigmoid(p["opacity_logits"])
    covariances, _ = reference._quat_scale_to_covar_preci(p["quats"], torch.exp(p["log_scales"]), True, False, False)
    radii, means2d, depths, conics, _ = reference._fully_fused_projection(p["means"], covariances, viewmat[None], K[None], width, height)
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colours = torch.clamp_min(reference._spherical_harmonics(3, p["means"] - eye, p["sh"]) + 0.5, 0)
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    # Tile keys hold the depth's float32 bits.
    _, keys, ids = reference._isect_tiles(means2d.detach().float(), radii, depths.detach().float(), TILE, columns, rows)
    offsets = reference._isect_offset_encode(keys, 1, columns, rows)
    image, alpha = reference._rasterize_to_pixels(means2d, conics, colours[None], opacities[None], width, height, TILE, offsets, ids,
                                                  backgrounds=background[None], batch_per_iter=1 << 20)
    return image[0], alpha[0, ..., 0]


def choose_splats(garden, viewmat, K, width, height, count, rng):
    """Up to `count` splats at garden points in front of the camera, with random shape, opacity (0.05 to 0.95) and view dependence."""
    points = garden["means3d"].astype(np.float64)
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixel = (camera @ K.T)[:, :2] / camera[:, 2:]
    margin = 0.1 * np.array([width, height])
    inside = (camera[:, 2] > 0.3) & (pixel > -margin).all(1) & (pixel < [width, height] + margin).all(1)
    chosen = np.sort(rng.choice(np.flatnonzero(inside), count, replace=False))
    depth = camera[chosen, 2]
    order = np.argsort(depth)
    apart = np.diff(depth[order], prepend=0) > 4e-6 * depth[order]
    chosen = np.sort(chosen[order[apart]])  # the order of the rest must not depend on float32 rounding
    count = len(chosen)
    opacity = rng.uniform(0.05, 0.95, count)
    sh = rng.normal(scale=0.1, size=(count, 16, 3))
    sh[:, 0] = (garden["colors"][chosen] / 255 - 0.5) / SH_C0
    # One to five pixels wide at any depth.
    size = camera[chosen, 2:] / K[0, 0] * np.exp(rng.uniform(np.log(0.5), np.log(2.5), (count, 3)))
    logits = np.log(opacity / (1 - opacity))
    p = dict(means=points[chosen], quats=rng.normal(size=(count, 4)), log_scales=np.log(size), opacity_logits=logits, sh=sh)
    return {name: value.astype(np.float32) for name, value in p.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garden")
    parser.add_argument("output")
    parser.add_argument("--splats", type=int, default=3000)
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--downscale", type=int, default=8)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    garden = np.load(arguments.garden)
    width, height = int(garden["width"]) // arguments.downscale, int(garden["height"]) // arguments.downscale
    viewmat, K = garden["viewmats"][arguments.view].astype(np.float32), garden["Ks"][arguments.view].astype(np.float32)
    K[:2] /= arguments.downscale
    splats = choose_splats(garden, viewmat.astype(float), K.astype(float), width, height, arguments.splats, rng)
    background = np.array([0.2, 0.4, 0.6], np.float32)
    upstream = rng.normal(size=(height, width, 3)).astype(np.float32)

    as_double = lambda array: torch.from_numpy(array).double()
    parameters = {name: as_double(value).requires_grad_() for name, value in splats.items()}
    image, alpha = render(load_gsplat(), parameters, as_double(viewmat), as_double(K), width, height, as_double(background))
    (image * as_double(upstream)).sum().backward()
    gradients = {f"grad_{name}": value.grad.numpy() for name, value in parameters.items()}
    results = dict(image=image.detach().numpy(), alpha=alpha.detach().numpy(), image_gradient=upstream, **gradients)
    tensors = splats | dict(viewmat=viewmat, K=K, background=background) | results
    safetensors.numpy.save_file({name: np.ascontiguousarray(t) for name, t in tensors.items()}, arguments.output)
    print(f"{arguments.output}: {len(splats['means'])} splats, {width}x{height}, mean colour {image.mean().item():.6f}, "
          f"mean alpha {alpha.mean().item():.4f}; largest " + ", ".join(f"{n} {np.abs(g).max():.3g}" for n, g in gradients.items()))


if __name__ == "__main__":
    main()
