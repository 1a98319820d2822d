"""Writes the weights of LPIPS v0.1 as the safetensors file that `centaur eval --lpips-weights` reads.

The weights are downloaded by torchvision and the lpips package, under their licences:
  pip install lpips==0.1.4 torchvision safetensors
  python lpips_weights.py vgg lpips-vgg.safetensors        # or: alex lpips-alex.safetensors
"""

import argparse
import os
import pathlib
import tempfile


def tensors(model, net):
    """Name → tensor of an `lpips.LPIPS` model, in the names of METHODS 8."""
    import torch

    found, block, index = {}, 1, 0
    slices = [getattr(model.net, f"slice{i}") for i in range(1, 6)]
    for number, part in enumerate(slices, 1):
        for layer in part:
            if isinstance(layer, torch.nn.MaxPool2d):
                block, index = block + 1, 0
            if isinstance(layer, torch.nn.Conv2d):
                index += 1
                name = f"conv{block}_{index}" if net == "vgg" else f"conv{number}"
                found[f"{name}.weight"], found[f"{name}.bias"] = layer.weight, layer.bias
    for k, lin in enumerate(model.lins):
        (weight,) = lin.parameters()
        found[f"lin{k}.weight"] = weight.flatten()
    return {name: t.detach().float().contiguous().clone() for name, t in found.items()}


def write(model, net, path):
    """Under another name until it is complete."""
    from safetensors.torch import save_file

    path = pathlib.Path(path)
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        save_file(tensors(model, net), part, metadata={"lpips": "0.1", "net": net})
        os.replace(part, path)
    except BaseException:
        os.unlink(part)
        raise


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=["vgg", "alex"], help="vgg: tables of 3DGS; alex: gsplat")
    parser.add_argument("output", help="file to write, .safetensors")
    args = parser.parse_args()
    try:
        import lpips
    except ImportError as error:
        raise SystemExit(f"{error.name} is missing: pip install lpips==0.1.4 torchvision safetensors")
    write(lpips.LPIPS(net=args.net, version="0.1", verbose=False), args.net, args.output)
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()
