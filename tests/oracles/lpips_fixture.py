"""LPIPS with random weights by its own package, layer by layer: the fixture of tests/lpips_oracle.rs.

  lpips_fixture.py FOLDER    writes FOLDER/{vgg,alex}.safetensors (weights, by datasets-scripts/lpips_weights.py) and
                             {vgg,alex}.json: distances of two pictures at every depth, colours −1…1 and 0…1

The weights of the published networks need not be downloaded: whoever agrees on random ones does so on any.
"""

import json
import pathlib
import sys

import lpips
import numpy as np
import torch

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "datasets-scripts"))
import lpips_weights  # noqa: E402

SIZES = [(64, 64), (71, 53)]


def picture(width, height, phase):
    """Smooth waves with some noise, 8 bits, which the test makes anew from the bytes."""
    y, x = np.mgrid[0:height, 0:width]
    waves = [np.sin(0.3 * x + phase + c) * np.cos(0.2 * y - phase * c) for c in range(3)]
    noise = np.random.default_rng(int(10 * phase)).uniform(-0.2, 0.2, (height, width, 3))
    return np.clip(127.5 + 100 * np.stack(waves, -1) + 127.5 * noise, 0, 255).astype(np.uint8)


def main():
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for net in ["vgg", "alex"]:
        torch.manual_seed(7)
        model = lpips.LPIPS(net=net, version="0.1", pretrained=False, pnet_rand=True, verbose=False).eval()
        with torch.no_grad():
            for layer in model.net.modules():
                if isinstance(layer, torch.nn.Conv2d):
                    torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                    layer.bias.uniform_(-0.1, 0.1)
            for lin in model.lins:
                for weight in lin.parameters():
                    weight.uniform_(0, 1)
            lpips_weights.write(model, net, folder / f"{net}.safetensors")
            cases = []
            for width, height in SIZES:
                pair = [picture(width, height, phase) for phase in (0.4, 0.9)]
                a, b = (torch.from_numpy(p.astype(np.float32) / 255).permute(2, 0, 1)[None] for p in pair)
                case = {"width": width, "height": height, "pictures": [p.flatten().tolist() for p in pair]}
                for name, normalize in [("normalized", True), ("unnormalized", False)]:
                    total, layers = model(a, b, normalize=normalize, retPerLayer=True)
                    case[name] = [float(layer) for layer in layers]
                    assert abs(sum(case[name]) - float(total)) < 1e-5
                cases.append(case)
        (folder / f"{net}.json").write_text(json.dumps(cases))
        print(net, [[round(v, 5) for v in c["normalized"]] for c in cases])


if __name__ == "__main__":
    main()
