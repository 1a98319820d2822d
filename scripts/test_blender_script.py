"""Option handling of the script for Blender, and its behaviour in the text editor, without Blender."""
import contextlib
import io
import json
import os
import pathlib
import re
import struct
import sys
import tempfile
import unittest
from types import SimpleNamespace
from unittest import mock

PARTS = pathlib.Path(__file__).parent.parent / "src/format/blender"


def assembled(names, **more):
    """The script for a scene with cameras of these names, assembled as in `mod.rs`."""
    rule = {"colorSpace": "srgb", "background": [0, 0, 0], "near": 0.2, "lowPass": [0.3, 0]}
    scene = {"name": "s", "splats": None, "meshes": [], "motion": None, "cameras": [{"name": name} for name in names], "composition": rule}
    scene.update(more)
    parts = re.findall(r'include_str!\("(\w+\.py)"\)', (PARTS / "mod.rs").read_text(encoding="utf-8"))
    head, *rest = ((PARTS / part).read_text(encoding="utf-8") for part in parts)
    return "\n\n".join([f"#!/usr/bin/env python3\n{head}\nSCENE = json.loads(r'''{json.dumps(scene)}''')", *rest])


def script(names, **more):
    """Names defined by the script."""
    module = {"__name__": "script"}
    exec(assembled(names, **more), module)
    return module


class Text:
    """A text of Blender."""

    def __init__(self, content=""):
        self.content, self.filepath = content, ""

    def as_string(self):
        return self.content

    def from_string(self, content):
        self.content = content


class Texts(dict):
    """Texts by name, sorted by Blender; iterating gives the texts."""

    def __iter__(self):
        return iter([self[name] for name in sorted(self.keys())])

    def new(self, name):
        return self.setdefault(name, Text())


class Empty(dict):
    """The empty that is the parent of scenes, with its properties."""

    type, data, children_recursive, users_collection = "EMPTY", None, (), ()
    __hash__ = object.__hash__


class Blender:
    """The parts of Blender needed to run a text in its editor, in a file with these texts and optionally the scene."""

    def __init__(self, is_built, **texts):
        things = [Empty(centaur=json.dumps({"scene": "s"}))] if is_built else []
        self.texts = Texts({f"{name}.py": Text(content) for name, content in texts.items()})
        self.handlers = SimpleNamespace(frame_change_post=[], render_init=[], persistent=lambda function: function)
        self.bpy = mock.MagicMock()
        self.bpy.app.binary_path, self.bpy.app.background, self.bpy.app.version = "/usr/bin/blender", False, (4, 5, 15)
        self.bpy.app.handlers, self.bpy.data.texts = self.handlers, self.texts
        self.bpy.context.scene.objects, self.bpy.context.scene.camera = things, None
        self.bpy.data.batch_remove = lambda removed: [things.remove(thing) for thing in removed]

    def names(self, text, name="__main__"):
        """Names defined by a text after it was run."""
        module = {"__name__": name, "__file__": f"/tmp/a.blend/{text}"}
        modules = {"bpy": self.bpy, "numpy": mock.MagicMock(), "mathutils": mock.MagicMock()}
        with mock.patch.dict(sys.modules, modules), mock.patch.object(sys, "argv", ["blender"]):
            exec(self.texts[text].as_string(), module)
        return module


class TextEditor(unittest.TestCase):
    def test_a_text_of_the_user_builds_again(self):
        for is_built in (False, True):
            blender, runs = Blender(is_built, garden=assembled([])), []
            module = blender.names("garden.py", "text")
            module["run"] = runs.append
            with mock.patch.object(sys, "argv", ["blender"]):
                module["main"]()
            self.assertEqual(len(runs), 1, is_built)

    def test_the_stored_text_listens_and_builds_nothing(self):
        for is_built, is_background in ((True, False), (False, False), (False, True)):
            blender = Blender(is_built, garden=assembled([]))
            blender.names("garden.py", "text")["keep_script"]()
            blender.bpy.app.background = is_background
            blender.names("centaur.py")
            self.assertEqual([len(h) for h in (blender.handlers.frame_change_post, blender.handlers.render_init)], [1, 1])
            blender.bpy.data.collections.new.assert_not_called()
            blender.bpy.ops.wm.read_factory_settings.assert_not_called()
            self.assertTrue(blender.texts["centaur.py"].use_module)

    def test_the_text_that_runs_is_stored_of_several(self):
        own = assembled(["new"])
        blender = Blender(True, a=assembled(["old"]), garden=own)
        for _ in range(2):
            blender.names("garden.py", "text")["keep_script"]()
            marker, _, stored = blender.texts["centaur.py"].content.partition("\n")
            self.assertTrue(marker.startswith("CENTAUR_STORED = True"))
            self.assertEqual(stored, own)
        with contextlib.redirect_stderr(io.StringIO()) as said:
            module = blender.names("garden.py", "text")
            module["__file__"] = "<console>"
            module["keep_script"]()
        self.assertEqual(blender.texts["centaur.py"].content.partition("\n")[2], own)
        self.assertIn("neither a file nor a text", said.getvalue())

    def failed(self, is_built, build=None, **scene):
        """Messages, and remaining objects, after a run that fails."""
        blender = Blender(is_built, garden=assembled([], **scene))
        module = blender.names("garden.py", "text")
        module["home"] = lambda: "/nowhere"
        if build:
            module["build"] = lambda *_: build(blender.bpy.context.scene.objects)
        with self.assertRaises(RuntimeError) as caught, mock.patch.object(sys, "argv", ["blender"]):
            module["main"]()
        blender.bpy.data.collections.new.assert_not_called()
        return str(caught.exception), len(blender.bpy.context.scene.objects)

    def test_a_file_that_is_missing_changes_nothing(self):
        lies = "it lies beside the script where `centaur convert` wrote it"
        for scene, name in [
            ({"splats": "s.ply"}, "s.ply"),
            ({"meshes": [{"surface": "m.ply", "maps": []}]}, "m.ply"),
            ({"meshes": [{"surface": "m.ply", "maps": ["m.exr"]}]}, "m.exr"),
        ]:
            for is_built in (False, True):
                said, things = self.failed(is_built, **scene)
                self.assertRegex(said, rf"\A/nowhere/{name}: cannot read.*{lies}\Z")
                self.assertEqual(things, int(is_built))

    def test_what_a_failed_build_has_made_is_removed(self):
        def build(things):
            things.append(Empty(centaur=json.dumps({"scene": "s"})))
            raise RuntimeError("in the middle")

        self.assertEqual(self.failed(False, build), ("in the middle", 0))
        self.assertEqual(self.failed(True, build), ("in the middle", 0))



class Cameras(unittest.TestCase):
    def test_a_camera_is_chosen_by_name_or_number(self):
        index = script(["front", "IMG 2.jpg", "007", "1", "front"])["camera_index"]
        found = {text: index(text) for text in ("0", "4", "front", "IMG 2.jpg", "1", "007", "03")}
        self.assertEqual(found, {"0": 0, "4": 4, "front": 0, "IMG 2.jpg": 1, "1": 3, "007": 2, "03": 3})
        for text in ("5", "back", "", "-1", "\u00b2", "IMG", "9" * 9999):
            self.assertIsNone(index(text), text)

    def test_an_unknown_name_is_one_line_with_some_of_the_names(self):
        module = script(["a\nb", "c", "d", "e", "f", "g"])
        check = lambda text: module["check"](module["parse"](["--camera", text]))
        check("c")
        check("5")
        with self.assertRaises(module["ScriptError"]) as caught:
            check("x\n")
        self.assertEqual(str(caught.exception), "--camera: expected 0 to 5, a name (a\\nb, c, d, e, f, …), `all` or `path`, found x\\n")


class Names(unittest.TestCase):
    def test_messages_name_the_file_that_runs(self):
        for file, name in ((None, "s.blend.py"), ("/tmp/we ird.py", "we ird.py"), ("/tmp/a.blend/garden.py", "garden.py")):
            module = {"__name__": "script"} | ({"__file__": file} if file else {})
            exec(assembled(["a"]), module)
            for arguments in (["--help"], ["--triangles", "0"]):
                said = io.StringIO()
                with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), self.assertRaises(SystemExit):
                    module["parse"](arguments)
                self.assertIn(f"usage: {name} ", said.getvalue())
                self.assertNotIn("NAME.blend.py", said.getvalue())
            with contextlib.redirect_stderr(io.StringIO()) as said:
                module["say"]("hello")
            self.assertEqual(said.getvalue(), f"{name}: hello\n")

    def test_triangles_are_at_least_one(self):
        parse = script(["a"])["parse"]
        self.assertEqual(parse(["--triangles", "1"]).triangles, 1)
        for count in ("0", "-5"):
            with contextlib.redirect_stderr(io.StringIO()) as said, self.assertRaises(SystemExit):
                parse([f"--triangles={count}"])
            self.assertIn(f"--triangles: expected at least 1, found {count}", said.getvalue())


class Maps(unittest.TestCase):
    def test_a_map_that_is_cut_is_none(self):
        is_whole = script([])["is_whole_exr"]

        def whole(content):
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder, "a.exr")
                path.write_bytes(content)
                return is_whole(path)

        entry = lambda name, kind, data: name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data
        for is_tiled in (True, False):
            header = struct.pack("<2I", 20000630, 0x202 if is_tiled else 2) + entry(b"chunkCount", b"int", struct.pack("<i", 2))
            header += (entry(b"tiles", b"tiledesc", bytes(9)) if is_tiled else b"") + b"\0"
            block = bytes(16 if is_tiled else 4) + struct.pack("<i", 3) + b"abc"
            start = len(header) + 16
            content = header + struct.pack("<2Q", start + len(block), start) + 2 * block
            self.assertTrue(whole(content))
            self.assertFalse(any(whole(content[:length]) for length in range(len(content))))
        self.assertFalse(whole(b"PNG" + bytes(500)))


class Pictures(unittest.TestCase):
    def test_what_the_script_reads_is_not_written_over(self):
        module = script(["a"], meshes=[{"surface": "s_mesh0.ply", "maps": ["s_mesh0_sh00.exr"]}])
        with tempfile.TemporaryDirectory() as folder:
            module["home"] = lambda: folder
            check = lambda name: module["check"](module["parse"](["--render", os.path.join(folder, ".", name)]))
            check("s_mesh0_sh00.exr")
            for name in ("s_mesh0_sh00.exr", "other.exr"):
                pathlib.Path(folder, name).touch()
            check("other.exr")
            with self.assertRaises(module["ScriptError"]) as caught:
                check("s_mesh0_sh00.exr")
            self.assertRegex(str(caught.exception), r"s_mesh0_sh00\.exr: cannot write: this script reads a file of this name\Z")

    def test_one_folder_is_made_for_them(self):
        module = script(["a"])
        check = lambda *path: module["check"](module["parse"](["--render", os.path.join(*path)]))
        with tempfile.TemporaryDirectory() as folder:
            pathlib.Path(folder, "taken").touch()
            check(folder, "frames", "out.png")
            check(folder, "out.png")
            self.assertEqual(os.listdir(folder), ["taken"], "before there is a picture")
            for names in (("a", "b", "out.png"), ("taken", "out.png")):
                with self.assertRaises(module["ScriptError"]) as caught:
                    check(folder, *names)
                self.assertIn(f"cannot write: {os.path.join(folder, *names[:-1])} is no folder", str(caught.exception))
            with self.assertRaises(module["ScriptError"]):
                module["check"](module["parse"](["--save", os.path.join(folder, "frames", "a.blend")]))
            for _ in range(2):
                module["make_folder"](os.path.join(folder, "frames", "out.png"))
            self.assertTrue(os.path.isdir(os.path.join(folder, "frames")))
            with self.assertRaises(module["ScriptError"]):
                module["make_folder"](os.path.join(folder, "taken", "out.png"))


class Frames(unittest.TestCase):
    def test_frames_are_those_that_blender_has(self):
        module = script(["a", "b", "c"])
        for text in ("1", "1048574", "all"):
            module["check"](module["parse"](["--frame", text, "--camera", "a"] if text != "all" else ["--frame", text]))
        for text in ("0", "-1", "\u00b2", "1048575", "9" * 30, "1.5"):
            said = io.StringIO()
            with contextlib.redirect_stderr(said), self.assertRaises(SystemExit):
                module["parse"]([f"--frame={text}"])
            self.assertIn(f"--frame: expected a number from 1 to 1048574, or `all`, found {text}", said.getvalue())
        check = lambda frames: module["check"](module["parse"](["--path", str(frames)]))
        check(524286)
        with self.assertRaises(module["ScriptError"]):
            check(524287)


if __name__ == "__main__":
    unittest.main()
