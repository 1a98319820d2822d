"""LPIPS by its own package, layer by layer: the fixture of tests/integration/lpips_oracle.rs.

  lpips_fixture.py FOLDER VGG.safetensors ALEX.safetensors
      writes FOLDER/{random,published}-{vgg,alex}.safetensors (weights, by datasets-scripts/lpips_weights.py) and .json:
      distances of two pictures at every depth, colours −1…1 and 0…1

Random weights test the arithmetic for arbitrary weights; the published ones, from the given files, test that the
converter's output has the same meaning for both programs.
"""

import json
import pathlib
import sys
from importlib.metadata import version

import lpips
import numpy as np
import torch
from safetensors.torch import load_file

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "datasets-scripts"))
import lpips_weights  # noqa: E402

SIZES = [(64, 64), (71, 53)]


def picture(width, height, phase):
    """Smooth waves with some noise, 8 bits, which the test reconstructs from the bytes."""
    y, x = np.mgrid[0:height, 0:width]
    waves = [np.sin(0.3 * x + phase + c) * np.cos(0.2 * y - phase * c) for c in range(3)]
    noise = np.random.default_rng(int(10 * phase)).uniform(-0.2, 0.2, (height, width, 3))
    return np.clip(127.5 + 100 * np.stack(waves, -1) + 127.5 * noise, 0, 255).astype(np.uint8)


def tensor(picture):
    """Colours 0…1 of an 8-bit picture, as the package takes them."""
    return torch.from_numpy(picture.astype(np.float32) / 255).permute(2, 0, 1)[None]


@torch.no_grad()
def random_model(net):
    torch.manual_seed(7)
    model = lpips.LPIPS(net=net, version="0.1", pretrained=False, pnet_rand=True, verbose=False).eval()
    for layer in lpips_weights.convolutions(model):
        torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
        layer.bias.uniform_(-0.1, 0.1)
    for lin in model.lins:
        for weight in lin.parameters():
            weight.uniform_(0, 1)
    return model


@torch.no_grad()
def published_model(net, file):
    """A model with the package's linear layers and the file's convolutions."""
    model = lpips.LPIPS(net=net, version="0.1", pnet_rand=True, verbose=False).eval()
    put_convolutions(model, net, load_file(file))
    return model


@torch.no_grad()
def put_convolutions(model, net, weights):
    for name, layer in zip(lpips_weights.NETS[net].convolutions, lpips_weights.convolutions(model), strict=True):
        layer.weight.copy_(weights[f"{name}.weight"])
        layer.bias.copy_(weights[f"{name}.bias"])


@torch.no_grad()
def write(folder, name, net, model):
    lpips_weights.write(lpips_weights.of_model(model, net), net, folder / f"{name}.safetensors")
    cases = []
    for width, height in SIZES:
        pair = [picture(width, height, phase) for phase in (0.4, 0.9)]
        case = {"width": width, "height": height, "pictures": [p.flatten().tolist() for p in pair]}
        for range_, normalize in [("normalized", True), ("unnormalized", False)]:
            total, layers = model(*map(tensor, pair), normalize=normalize, retPerLayer=True)
            case[range_] = [float(layer) for layer in layers]
            assert abs(sum(case[range_]) - float(total)) < 1e-5
        cases.append(case)
    (folder / f"{name}.json").write_text(json.dumps(cases))
    print(name, [[round(v, 5) for v in c["normalized"]] for c in cases])


def main():
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for net, file in zip(["vgg", "alex"], sys.argv[2:], strict=True):
        write(folder, f"random-{net}", net, random_model(net))
        write(folder, f"published-{net}", net, published_model(net, file))
        # The linear layers are the package's here, so this compares those of the file bit by bit.
        written = (folder / f"published-{net}.safetensors").read_bytes()
        assert written == pathlib.Path(file).read_bytes(), f"{file} is not what --from lpips writes"
        print(f"{file}: as --from lpips writes it; linear layers are those of lpips {version('lpips')}, bit by bit")


if __name__ == "__main__":
    main()
