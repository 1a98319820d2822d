"""Checks that LPIPS weights are the published ones, and that `centaur eval` scores with them as the authors' package
does.

  check_lpips.py VGG.safetensors FOLDER ALEX.safetensors FOLDER      folders of `centaur eval --lpips-weights … -o FOLDER`

torchvision's server is not used: its weights are recognised by values that others have printed.
"""

import math
import sys
from unittest import mock

import eval_sheets
import lpips
import numpy as np
import torch
import torchvision
from lpips_fixture import published_model, put_convolutions, tensor
from safetensors.torch import load_file

# Five digits, printed by torch for the weights distributed by torchvision: beginning of the first convolution, corners
# of its first row, end of the last one.
PRINTED = {
    "vgg": [
        ("conv1_1.weight", (0, 0, 0), [-0.5537, 0.1427, 0.5290]),
        ("conv5_3.weight", (511, 510, 0), [-3.3155e-03, -8.4667e-03, 4.0157e-03]),
        ("conv5_3.weight", (511, 510, 1), [1.9905e-02, -1.0356e-02, -4.5904e-04]),
        ("conv5_3.weight", (511, 510, 2), [3.1526e-02, 1.0053e-02, 1.1222e-02]),
        ("conv5_3.weight", (511, 511, 0), [-2.6271e-02, -8.1591e-03, -2.9560e-02]),
        ("conv5_3.weight", (511, 511, 1), [-3.3923e-02, -2.4079e-02, -2.2005e-02]),
        ("conv5_3.weight", (511, 511, 2), [-3.4229e-02, -2.6150e-02, -1.4213e-02]),
    ],
    "alex": [
        ("conv1.weight", (0, 0, 0, slice(0, 3)), [1.1864e-01, 9.4069e-02, 9.5435e-02]),
        ("conv1.weight", (0, 0, 0, slice(8, 11)), [5.5822e-02, 2.1575e-02, 4.9963e-02]),
    ],
}
# Half of the fourth digit, plus rounding of f32 sums. Noise of 1 % in any one convolution changes at least three of the
# ten distances below by more; a convolution with weights rounded to 16 bits changes none to two.
PRINTED_TO = 0.55e-4
# VGG distances of ten pairs of pictures of numpy.random.seed(123), printed by a user of the package, −1…1.
OF_NUMPY = [0.3497, 0.3494, 0.3473, 0.3558, 0.3437, 0.3366, 0.3716, 0.3516, 0.3472, 0.3413]
# Their mean for torch.manual_seed(123), in the documentation of torchmetrics: 0.11 for −1…1, 0.8 for 0…1.
OF_TORCH = {True: 0.3493, False: 0.3566}


@torch.no_grad()
def check_published_distances(file):
    """Checks VGG to the four printed digits. For AlexNet, no published distances of available pictures were found."""
    model = published_model("vgg", file)
    np.random.seed(123)
    pair = [torch.tensor(np.random.rand(10, 3, 100, 100), dtype=torch.float32) for _ in range(2)]
    found = model(*pair, normalize=True).flatten().tolist()
    print("VGG, numpy's pictures:", [f"{d:.4f}" for d in found])
    assert all(abs(f - d) < PRINTED_TO for f, d in zip(found, OF_NUMPY, strict=True))

    # There the network, with all its layers, is created between setting the seed and making the pictures, which draws
    # random numbers.
    torch.manual_seed(123)
    make = torchvision.models.vgg16
    with mock.patch.object(lpips.pretrained_networks.tv, "vgg16", lambda pretrained: make(init_weights=False)):
        model = lpips.LPIPS(net="vgg", version="0.1", verbose=False).eval()
    put_convolutions(model, "vgg", load_file(file))
    pair = [torch.rand(10, 3, 100, 100) for _ in range(2)]
    for normalize, published in OF_TORCH.items():
        found = float(model(*pair, normalize=normalize).mean())
        print(f"VGG, torch's pictures, {'−1…1' if normalize else '0…1'}: {found:.4f}, published {published}")
        assert abs(found - published) < PRINTED_TO


def check_printed(net, weights):
    for name, at, printed in PRINTED[net]:
        found = weights[name][at].tolist()
        # Half of the last digit that torch prints: the fourth decimal, or the fifth significant digit.
        half = [0.51e-4 if abs(p) > 0.12 else 0.51 * 10.0 ** (math.floor(math.log10(abs(p))) - 4) for p in printed]
        assert all(abs(f - p) <= h for f, p, h in zip(found, printed, half, strict=True)), f"{name} {at}: {printed} {found}"
    print(f"{net}: {sum(len(p) for *_, p in PRINTED[net])} printed weights of torchvision agree")


@torch.no_grad()
def check_views(net, file, folder):
    model, worst, count = published_model(net, file), 0, 0
    for view, truth, render in eval_sheets.views(folder):
        for name, normalize in (("normalized", True), ("unnormalized", False)):
            expected = float(model(tensor(truth), tensor(render), normalize=normalize))
            found = view["lpips"][name]
            assert view["lpips"]["net"] == net
            difference = abs(found / expected - 1)
            # Also true for NaN.
            assert difference < 1e-4, f"{net} {view['name']} {name}: {found}, by the package {expected}"
            worst, count = max(worst, difference), count + 1
            print(f"{net} {view['name']} {name}: {found:.6f}, by the package {expected:.6f}")
    print(f"{folder}: {count} distances, largest relative difference {worst:.1e}")
    assert count


if __name__ == "__main__":
    arguments = dict(zip(["vgg", "vgg_views", "alex", "alex_views"], sys.argv[1:], strict=True))
    for net in ("vgg", "alex"):
        check_printed(net, load_file(arguments[net]))
        check_views(net, arguments[net], arguments[f"{net}_views"])
    check_published_distances(arguments["vgg"])
