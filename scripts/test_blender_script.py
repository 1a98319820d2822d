"""What the script for Blender makes of its options, where there is no Blender."""
import contextlib
import io
import pathlib
import re
import unittest

PARTS = pathlib.Path(__file__).parent.parent / "src/format/blender"


def script(names):
    """The script's names, of a scene with cameras of these names."""
    module = {"__name__": "script", "SCENE": {"name": "s", "cameras": [{"name": name} for name in names]}}
    for part in re.findall(r'include_str!\("(\w+\.py)"\)', (PARTS / "mod.rs").read_text(encoding="utf-8")):
        exec((PARTS / part).read_text(encoding="utf-8"), module)
    return module


class Cameras(unittest.TestCase):
    def test_a_camera_is_chosen_by_number_or_name(self):
        index = script(["front", "IMG 2.jpg", "007", "1", "front"])["camera_index"]
        found = {text: index(text) for text in ("0", "4", "front", "IMG 2.jpg", "1", "007", "03")}
        self.assertEqual(found, {"0": 0, "4": 4, "front": 0, "IMG 2.jpg": 1, "1": 1, "007": 2, "03": 3})
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
