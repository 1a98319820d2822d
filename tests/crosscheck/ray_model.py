"""The image model `ray` in numpy, written from its definition: an independent check of `centaur render --model ray`.

For a pixel's ray, o + t d with d of depth 1: a splat has its peak at t* = -o'.d'/d'.d' in its own whitened space, the squared
distance m2 there, and alpha = min(opacity exp(-m2/2), 0.99) if that is at least 1/255 and both t* and the mean's depth are
beyond near. Splats by t* and surfaces by depth are blended front to back. Surfaces, and glTF, are those of ../oracles/composition.py.
"""
import pathlib
import sys

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "oracles"))
from composition import KHR, View, contract_of, mesh_layers, orthogonal, rotations, sh_basis


def splats_of(asset):
    """Means, whitening matrices, opacities and SH coefficients of all splats, and the rotation of their frame, [3, 3]
    or one each."""
    for node, matrix in asset.nodes():
        for primitive in asset.json["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            if KHR not in primitive.get("extensions", {}):
                continue
            get = lambda name: asset.accessor(primitive["attributes"][name])
            names = [f"{KHR}:SH_DEGREE_{l}_COEF_{m}" for l in range(4) for m in range(2 * l + 1)]
            sh = np.stack([get(n) for n in names if n in primitive["attributes"]], 1)
            axes = matrix[:3, :3] @ rotations(get(f"{KHR}:ROTATION")) * get(f"{KHR}:SCALE")[:, None, :]
            mean, turn = get("POSITION") @ matrix[:3, :3].T + matrix[:3, 3], primitive.get("turn", orthogonal(matrix))
            return mean, np.linalg.inv(axes), get(f"{KHR}:OPACITY"), sh, turn
    return None


def render(asset, camera=0, by_mean=True):
    """Returns the image [h, w, 4], premultiplied, without background, and its layers of splats and of surfaces,
    likewise."""
    cameras = [n for n, _ in asset.nodes() if "camera" in n]
    kept = {id(n): n.pop("camera") for n in cameras if n is not cameras[camera]}
    view, contract = View(asset), contract_of(asset)
    for node in cameras:
        node.update({"camera": kept[id(node)]} if id(node) in kept else {})
    near = contract.get("near", view.znear)
    depth, opacity, color = mesh_layers(asset, view, near, contract.get("layers", 1))
    layers = np.zeros((2, view.h, view.w, 4))
    splats = splats_of(asset)
    if splats is None:
        mean, whiten, alpha0, sh, turn = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, 1, 3)), np.eye(3)
    else:
        mean, whiten, alpha0, sh, turn = splats
    # A splat whose mean is not beyond the near plane is not drawn.
    alpha0 = np.where(view.to_camera(mean)[:, 2] > near, alpha0, 0)
    offset = view.center - mean
    o = np.einsum("nij,nj->ni", whiten, offset)
    towards = -offset / np.linalg.norm(offset, axis=1, keepdims=True)
    seen = np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", sh_basis((towards[:, None] @ turn)[:, 0])[:, : sh.shape[1]], sh))
    rows = max(1, 3_000_000 // (view.w * max(1, len(mean))))
    for j in range(0, view.h, rows):
        part = np.s_[j : min(j + rows, view.h)]
        ray = view.rays(*np.meshgrid(np.arange(view.w), np.arange(view.h)[part])).reshape(-1, 3) @ view.rotation
        d = np.einsum("nij,pj->npi", whiten, ray)
        dd, od = (d * d).sum(-1), np.einsum("npi,ni->np", d, o)
        t = -od / dd
        m2 = ((o[:, None] + t[..., None] * d) ** 2).sum(-1)
        alpha = alpha0[:, None] * np.exp(-0.5 * m2)
        alpha = np.where((alpha >= 1 / 255) & (t > near), np.minimum(alpha, 0.99), 0)
        rgb = np.broadcast_to(seen[:, None], (*alpha.shape, 3))
        if not by_mean:
            unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
            rgb = np.maximum(0, 0.5 + np.einsum("pk,nkc->npc", sh_basis(unit @ turn)[:, : sh.shape[1]], sh))
        count = len(depth)
        keys = np.concatenate([np.where(alpha > 0, t, np.inf), depth[:, part].reshape(count, -1)])
        alphas = np.concatenate([alpha, opacity[:, part].reshape(count, -1)])
        rgbs = np.concatenate([rgb, color[:, part].reshape(count, -1, 3)])
        order = np.argsort(keys, axis=0, kind="stable")  # splats come first: at equal depth they are in front
        alphas = np.take_along_axis(alphas, order, 0)
        t_before = np.cumprod(np.concatenate([np.ones((1, alphas.shape[1])), 1 - alphas]), axis=0)[:-1]
        weights = np.empty_like(alphas)
        np.put_along_axis(weights, order, alphas * t_before, 0)
        rgba = np.concatenate([rgbs, np.ones((*rgbs.shape[:2], 1))], -1) * weights[..., None]
        layers[0, part] = rgba[: len(mean)].sum(0).reshape(-1, view.w, 4)
        layers[1, part] = rgba[len(mean) :].sum(0).reshape(-1, view.w, 4)
    return layers.sum(0), *layers
