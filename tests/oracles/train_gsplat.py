"""Trains splats with gsplat's own kernels and MCMC strategy, for comparison with `centaur train --no-mesh`: same
photographs, iterations, number of splats, degree and learning rates.

    pip install gsplat==1.5.3 pillow scipy        (and torch; needs an NVIDIA GPU and its compiler, nvcc)
    centaur cameras convert CAPTURE -o cameras.json
    python train_gsplat.py CAPTURE cameras.json OUT.ply [--iterations 7000] [--max-splats 300000] [--json OUT.json]

CAPTURE is a COLMAP model of pinhole cameras with images/; every 8th photograph is held out. `centaur eval OUT.ply
CAPTURE` scores the result. Constants are the defaults of gsplat's example trainer for MCMC. To gsplat's advantage,
photographs are on the GPU before timing starts, and Adam is fused; to its disadvantage, SSIM, for which that trainer
uses a kernel that is not on PyPI, is compiled by torch: its time is reported separately. Density control begins after
500 iterations, so shorter runs have none.
The clock is stopped during set-up, the first ten iterations (which compile) and scoring.
"""

import argparse
import json
import struct
import time
from pathlib import Path

import numpy as np
import torch
from gsplat import export_splats
from gsplat.rendering import rasterization
from gsplat.strategy import MCMCStrategy
from PIL import Image

SH_C0 = 0.28209479177387814
HELD_OUT_EVERY = 8
WARM_UP = 10


def read_points(path):
    """Reads positions [N, 3] and colours [N, 3] in 0..1 from COLMAP's points3D.bin."""
    data = Path(path).read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, points, colours = 8, [], []
    for _ in range(count):
        _, x, y, z, r, g, b, _, track = struct.unpack_from("<Q3d3BdQ", data, at)
        at += 51 + 8 * track
        points.append((x, y, z))
        colours.append((r, g, b))
    return np.array(points, np.float32), np.array(colours, np.float32) / 255


def read_views(capture, cameras):
    """Reads world to camera [N, 4, 4] (OpenCV axes), intrinsics [N, 3, 3] and photographs [N, H, W, 3] u8, by name."""
    document = json.loads(Path(cameras).read_text())
    # With these the paths begin, relative to the file, which may lie anywhere.
    folder = document.get("centaur", {}).get("images", "") + "/"
    poses, intrinsics, photographs = [], [], []
    for frame in sorted(document["frames"], key=lambda f: f["file_path"]):
        k = document | frame
        pose = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        poses.append(np.linalg.inv(pose))
        intrinsics.append([[k["fl_x"], 0, k["cx"]], [0, k["fl_y"], k["cy"]], [0, 0, 1]])
        name = frame["file_path"].removeprefix(folder)
        photographs.append(np.asarray(Image.open(Path(capture) / "images" / name).convert("RGB")))
    as_f32 = lambda values: torch.tensor(np.array(values), dtype=torch.float32, device="cuda")
    return as_f32(poses), as_f32(intrinsics), torch.tensor(np.array(photographs), device="cuda")


WEIGHTS = torch.exp(-((torch.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
WEIGHTS = (WEIGHTS / WEIGHTS.sum()).tolist()


# Three graphs, so that the compiler stores blurred rows instead of blurring them again for every row of a column.
@torch.compile
def blur_rows(x, y):
    """[5, 3, H, W]: the windowed moments for SSIM of two pictures [3, H, W], blurred by a Gaussian of 11 taps along x,
    zeros outside."""
    maps = torch.nn.functional.pad(torch.stack([x, y, x * x, y * y, x * y]), (5, 5, 0, 0))
    return sum(WEIGHTS[i] * maps[..., i : i + x.shape[2]] for i in range(11))


@torch.compile
def blur_columns(rows):
    padded = torch.nn.functional.pad(rows, (0, 0, 5, 5))
    return sum(WEIGHTS[i] * padded[..., i : i + rows.shape[2], :] for i in range(11))


@torch.compile
def loss_of_means(x, y, means):
    mx, my, xx, yy, xy = means
    numerator = (2 * mx * my + 1e-4) * (2 * (xy - mx * my) + 9e-4)
    denominator = (mx * mx + my * my + 1e-4) * (xx - mx * mx + yy - my * my + 9e-4)
    return 0.8 * (x - y).abs().mean() + 0.2 * (1 - (numerator / denominator).mean())


def loss_of(image, truth):
    """0.8 L1 + 0.2 (1 - SSIM) of [H, W, 3] in 0..1, with SSIM as in INRIA's code."""
    x, y = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    return loss_of_means(x, y, blur_columns(blur_rows(x, y)))


def milliseconds_of_loss(image, truth):
    """Time of the loss and its gradient, the mean of 100 consecutive evaluations as in training."""
    x = image.detach().requires_grad_()
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    for _ in range(100):
        loss_of(x, truth.float() / 255).backward()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end) / 100


def initial_splats(points, colours):
    """Initial splats of gsplat's example trainer for MCMC."""
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points, k=4)[0][:, 1:]
    spacing = np.sqrt((distances**2).mean(axis=1))
    count = len(points)
    sh = torch.zeros(count, 16, 3)
    sh[:, 0] = torch.tensor((colours - 0.5) / SH_C0)
    return {
        "means": torch.tensor(points),
        "scales": torch.log(torch.tensor(spacing * 0.1)).float()[:, None].repeat(1, 3),
        "quats": torch.rand(count, 4),
        "opacities": torch.logit(torch.full((count,), 0.5)),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }


def optimised(values, scene_scale):
    """The splats as parameters on the GPU, with an optimiser each."""
    rates = {"means": 1.6e-4 * scene_scale, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
    parameters = torch.nn.ParameterDict({k: torch.nn.Parameter(v.float().contiguous()) for k, v in values.items()}).cuda()
    return parameters, {k: torch.optim.Adam([parameters[k]], lr=rates[k], eps=1e-15, fused=True) for k in values}


def read_ply(path):
    """Reads parameters of degree 3 from a PLY in INRIA's layout, by gsplat's names."""
    data = Path(path).read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode().split("\n")
    names = [line.split()[2] for line in header if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in header if line.startswith("element vertex "))
    columns = dict(zip(names, np.frombuffer(data, "<f4", count * len(names), end).reshape(count, -1).T))
    pick = lambda prefix, n: torch.tensor(np.stack([columns[f"{prefix}{i}"] for i in range(n)], 1))
    return {
        "means": torch.tensor(np.stack([columns[c] for c in "xyz"], 1)),
        "scales": pick("scale_", 3),
        "quats": pick("rot_", 4),
        "opacities": torch.tensor(columns["opacity"].copy()),
        "sh0": pick("f_dc_", 3)[:, None],
        "shN": pick("f_rest_", 45).reshape(count, 3, 15).permute(0, 2, 1),
    }


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("capture")
    arguments.add_argument("cameras")
    arguments.add_argument("out")
    arguments.add_argument("--iterations", type=int, default=7000)
    arguments.add_argument("--max-splats", type=int, default=300_000)
    arguments.add_argument("--start", metavar="FILE.ply", help="initial splats, with all their SH bands in use, instead of the points")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--json")
    options = arguments.parse_args()
    if options.iterations < 4 * WARM_UP:
        arguments.error(f"--iterations: expected at least {4 * WARM_UP}, as the first {WARM_UP} are not timed")
    if not torch.cuda.is_available():
        arguments.exit(1, "torch finds no NVIDIA GPU, which gsplat's kernels need\n")
    torch.manual_seed(options.seed)

    poses, intrinsics, photographs = read_views(options.capture, options.cameras)
    height, width = photographs.shape[1:3]
    centres = torch.linalg.inv(poses)[:, :3, 3]
    scene_scale = 1.1 * (centres - centres.mean(0)).norm(dim=1).max().item()
    points = Path(options.capture) / "sparse/0/points3D.bin"
    begin = read_ply(options.start) if options.start else initial_splats(*read_points(points))
    parameters, optimisers = optimised(begin, scene_scale)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], gamma=0.01 ** (1 / options.iterations))
    strategy = MCMCStrategy(cap_max=options.max_splats)
    strategy.check_sanity(parameters, optimisers)
    state = strategy.initialize_state()

    def render(view, degree):
        colours = torch.cat([parameters["sh0"], parameters["shN"]], 1)
        return rasterization(
            parameters["means"], parameters["quats"], parameters["scales"].exp(), parameters["opacities"].sigmoid(), colours,
            poses[view : view + 1], intrinsics[view : view + 1], width, height, sh_degree=degree, packed=False,
        )

    last = options.iterations - min(1000, options.iterations // 2)
    views = [v for v in range(len(poses)) if v % HELD_OUT_EVERY != 0]
    order, marks = [], []
    for iteration in range(options.iterations):
        if iteration in (WARM_UP, last) or iteration % 1000 == 0:
            torch.cuda.synchronize()
            marks.append((iteration, time.perf_counter(), len(parameters["means"])))
            print(*marks[-1], flush=True)
        if not order:
            order = [views[i] for i in torch.randperm(len(views)).tolist()]
        view = order.pop()
        image, _, info = render(view, 3 if options.start else min(iteration // 1000, 3))
        loss = loss_of(image[0], photographs[view].float() / 255)
        loss = loss + 0.01 * parameters["opacities"].sigmoid().mean() + 0.01 * parameters["scales"].exp().mean()
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(parameters, optimisers, state, iteration, info, lr=decay.get_last_lr()[0])
    torch.cuda.synchronize()
    marks.append((options.iterations, time.perf_counter(), len(parameters["means"])))

    scores = []
    with torch.no_grad():
        for view in range(0, len(poses), HELD_OUT_EVERY):
            error = render(view, 3)[0][0].clamp(0, 1) - photographs[view].float() / 255
            scores.append(-10 * torch.log10((error**2).mean()).item())
    seconds_at = {iteration: t for iteration, t, _ in marks}
    result = {
        "adapter": torch.cuda.get_device_name(),
        "iterations": options.iterations,
        "splats": len(parameters["means"]),
        "psnr": float(np.mean(scores)),
        "seconds": seconds_at[options.iterations] - seconds_at[WARM_UP],
        "last_iterations": options.iterations - last,
        "milliseconds_of_each_of_those": 1e3 * (seconds_at[options.iterations] - seconds_at[last]) / (options.iterations - last),
        "milliseconds_of_the_loss": milliseconds_of_loss(image[0], photographs[view]),
        "peak_bytes": torch.cuda.max_memory_allocated(),
        "marks": marks,
    }
    print(json.dumps(result, indent=1))
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=1))
    export_splats(
        parameters["means"], parameters["scales"], parameters["quats"], parameters["opacities"], parameters["sh0"], parameters["shN"],
        format="ply", save_to=options.out,
    )


main()
