"""LLVM, variant and camera chosen by hybrid_rf.py, and repeated tracing of rays, without Mitsuba: python3 -m unittest
discover -s scripts"""

import os
import runpy
import sys
import tempfile
import unittest
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

SCRIPT = Path(__file__).parent.parent / "src/format/mitsuba/hybrid_rf.py"
# Stand-ins with what is needed to import it.
MITSUBA = SimpleNamespace(variant=lambda: "", **dict.fromkeys(["BSDF", "Sensor", "Sampler", "SamplingIntegrator"], object))
# For a single ray, where Dr.Jit has arrays of rays.
DRJIT = SimpleNamespace(
    syntax=lambda method: method, eval=lambda *_: None, any=bool, count=lambda ray: [int(ray)],
    select=lambda which, one, other: one if which else other,
)  # fmt: skip
MODULES = {"mitsuba": MITSUBA, "drjit": DRJIT, "numpy": SimpleNamespace()}


def script():
    # The script sets a variable for Dr.Jit.
    with mock.patch.dict(sys.modules, MODULES), mock.patch.dict("os.environ"):
        return runpy.run_path(str(SCRIPT))


class Variants(unittest.TestCase):
    def variant(self, backends, platform="linux", llvm=None):
        """Variant chosen if Dr.Jit has these backends, where `llvm` is the user's choice of library."""
        chosen = []
        mitsuba = SimpleNamespace(**{**vars(MITSUBA), "variant": lambda: None, "set_variant": chosen.append})
        drjit = SimpleNamespace(
            **vars(DRJIT), JitBackend=SimpleNamespace(CUDA="cuda", LLVM="llvm"), has_backend=lambda backend: int(backend in backends)
        )
        modules = {**MODULES, "mitsuba": mitsuba, "drjit": drjit}
        environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
        with (
            mock.patch.dict(sys.modules, modules),
            mock.patch.dict("os.environ", {**environment, **({"DRJIT_LIBLLVM_PATH": llvm} if llvm else {})}, clear=True),
            mock.patch.object(sys, "platform", platform),
            mock.patch.object(Path, "glob", lambda *_: []),
        ):
            runpy.run_path(str(SCRIPT))
        return chosen

    def test_llvm_that_is_known_comes_first_and_then_a_gpu(self):
        self.assertEqual(self.variant({"cuda", "llvm"}, llvm="/lib/libLLVM.so"), ["llvm_ad_rgb"])
        self.assertEqual(self.variant({"cuda"}), ["cuda_ad_rgb"])
        self.assertEqual(self.variant({"cuda", "llvm"}), ["cuda_ad_rgb"])
        # In a folder that only Dr.Jit searches.
        self.assertEqual(self.variant({"llvm"}), ["llvm_ad_rgb"])
        for platform in ("win32", "darwin"):
            self.assertEqual(self.variant({"cuda", "llvm"}, platform), ["llvm_ad_rgb"])
            self.assertEqual(self.variant({"cuda"}, platform), ["cuda_ad_rgb"])

    def test_without_both_one_line_says_what_to_install(self):
        for platform in ("linux", "win32", "darwin"):
            with self.assertRaises(SystemExit) as caught:
                self.variant(set(), platform)
            self.assertRegex(caught.exception.code, r"\Ahybrid_rf\.py: needs LLVM \(apt install libllvm19; .*\) or an NVIDIA GPU\Z")


class Libraries(unittest.TestCase):
    def test_llvm_is_as_wide_as_this_python(self):
        own, other = (b"\2", b"\1") if sys.maxsize > 2**32 else (b"\1", b"\2")
        files = {"a/libLLVM.so.19.1": b"\x7fELF" + other, "b/libLLVM.so.18.1": b"\x7fELF" + own, "libLLVM-19.so": b"INPUT(-lLLVM)"}
        with tempfile.TemporaryDirectory() as folder, mock.patch.object(sys, "platform", "linux"):
            for name, head in files.items():
                path = Path(folder, name)
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(head + bytes(11))
            Path(folder, "a/libLLVM-20.so").symlink_to("nothing")
            find = script()["find_llvm"]
            self.assertEqual(find([folder]), f"{folder}/b/libLLVM.so.18.1")
            Path(folder, "b/libLLVM.so.19.1").write_bytes(files["b/libLLVM.so.18.1"])
            self.assertEqual(find([folder]), f"{folder}/b/libLLVM.so.19.1")
            Path(folder, "b/libLLVM.so.18.1").unlink()
            Path(folder, "b/libLLVM.so.19.1").unlink()
            self.assertIsNone(find([folder]))


class Cameras(unittest.TestCase):
    def setUp(self):
        self.index = script()["camera_index"]

    def refused(self, labels, text):
        with self.assertRaises(LookupError) as caught:
            self.index(labels, text)
        return str(caught.exception)

    def test_a_camera_is_chosen_by_name_or_number(self):
        labels = ["front", "IMG 2.jpg", "0", "front"]
        self.assertEqual([self.index(labels, text) for text in ("front", "IMG 2.jpg", "0", "1", "3")], [0, 1, 2, 1, 3])
        for text in ("4", "back", "", "-1", "\u00b2", "9" * 9999):
            self.assertEqual(
                self.refused(labels, text), f"no camera `{text}`; there are 0 (front), 1 (IMG 2.jpg), 2 (0), 3 (front)"
            )

    def test_a_name_is_compared_as_it_is_written(self):
        # As xml.rs replaces them.
        labels = ["a_b", "c__"]
        self.assertEqual([self.index(labels, text) for text in ("a$b", "a_b", "c\n\ufffe", "a\x80b")], [0, 0, 1, 0])
        self.refused(labels, "a b")

    def test_of_many_cameras_a_few_are_named(self):
        few = ", ".join(f"{i} ({i}.jpg)" for i in range(8))
        for count, rest in ((8, ""), (9, ", … to 8"), (300, ", … to 299")):
            labels = [f"{i}.jpg" for i in range(count)]
            self.assertEqual(self.refused(labels, "x"), f"no camera `x`; there are {few}{rest}")

    def test_none_is_said_as_convert_says_it(self):
        note = "there are no cameras: add a <sensor> to render images"
        self.assertEqual(self.refused([], "0"), note)
        self.assertIn(f'"{note}"', SCRIPT.with_name("mod.rs").read_text(encoding="utf-8"))


class Files(unittest.TestCase):
    def setUp(self):
        self.module = script()

    def failed(self, scene, out):
        with self.assertRaises(SystemExit) as caught:
            self.module["main"](SimpleNamespace(scene=Path(scene), out=Path(out)))
        return caught.exception.code

    def test_what_an_xml_refers_to_is_not_written_over(self):
        maps = '<bsdf type="hybrid_maps"><string name="map_00" value="a_mesh0_sh00.exr"/></bsdf>'
        with tempfile.TemporaryDirectory() as folder:
            scene, named, other = (Path(folder, name) for name in ("a.xml", "a_mesh0_sh00.exr", "b.exr"))
            for path in (named, other):
                path.touch()
            scene.write_text(f'<scene version="3.0.0"><string name="label" value="b.exr"/>{maps}</scene>', encoding="utf-8")
            said = self.failed(scene, Path(folder, "..", Path(folder).name, named.name))
            self.assertRegex(said, r"a_mesh0_sh00\.exr: cannot write: .*a\.xml refers to a file of this name\Z")
            self.assertEqual(self.module["files_of"](scene), [named])
            scene.write_text("<scene", encoding="utf-8")
            self.assertEqual(self.module["files_of"](scene), [])

    def test_a_map_that_cannot_be_read_is_named(self):
        def refuse(_):
            raise RuntimeError("many lines\nRuntimeError: read 3 out of 9 bytes ")

        load = self.module["HybridMaps"].load
        mitsuba = SimpleNamespace(Bitmap=refuse, file_resolver=lambda: SimpleNamespace(resolve=lambda name: name))
        stands_in = {"mi": mitsuba, "np": SimpleNamespace(array=None)}
        with mock.patch.dict(load.__globals__, stands_in), self.assertRaises(RuntimeError) as caught:
            load("a.exr", 4)
        self.assertEqual(str(caught.exception), "a.exr: cannot read (read 3 out of 9 bytes)")


class Slots(unittest.TestCase):
    def traced(self, needed, slots=64):
        """Numbers of slots with which a ray that needs `needed` slots is traced, and the number of rays that lack slots
        in the end."""
        tried = []

        def trace(scene, ray, slots, active=True):
            tried.append(slots)
            return slots, 1, [], slots < needed

        integrator = SimpleNamespace(slots=slots, trace=trace)
        *image, short = script()["HybridRF"].trace_all(integrator, None, None)
        self.assertEqual(image, [tried[-1], 1, []])
        return tried, short

    def test_a_ray_that_lacks_slots_is_traced_again_with_more(self):
        self.assertEqual(self.traced(64), ([64], 0))
        self.assertEqual(self.traced(65), ([64, 256], 0))
        self.assertEqual(self.traced(1024), ([64, 256, 1024], 0))
        self.assertEqual(self.traced(300, slots=300), ([300], 0))
        self.assertEqual(self.traced(301, slots=300), ([300, 1024], 0))

    def test_rays_that_lack_the_most_slots_are_counted(self):
        self.assertEqual(self.traced(1025), ([64, 256, 1024], 1))
        self.assertEqual(self.traced(5000, slots=4096), ([4096], 1))
        self.assertEqual(self.traced(4096, slots=4096), ([4096], 0))


if __name__ == "__main__":
    unittest.main()
