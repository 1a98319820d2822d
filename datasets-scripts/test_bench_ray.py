"""What bench_ray.py says of wrong calls, without Ray: python3 -m unittest discover datasets-scripts"""

import contextlib
import io
import subprocess
import sys
import types
import unittest
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import bench_ray


def refuse(address, **_):
    raise ConnectionError(f"no cluster at {address}\n  and why")


class Refused(unittest.TestCase):
    def refused(self, *arguments, ray=types.SimpleNamespace(init=refuse)):
        """Exit status and the last line that is said."""
        said = io.StringIO()
        with mock.patch.dict(sys.modules, ray=ray), contextlib.redirect_stderr(said), self.assertRaises(SystemExit) as end:
            bench_ray.main(list(arguments))
        code = end.exception.code
        return (1, code) if isinstance(code, str) else (code, said.getvalue().splitlines()[-1])

    def test_programs(self):
        missing = "error: /nonexistent/centaur: No such file or directory; put it into the PATH, or say with --program how to call it"
        self.assertEqual(self.refused("--program", "/nonexistent/centaur"), (1, missing))
        for program, expected in (
            ("./cen'taur", "No closing quotation: ./cen'taur"),
            *((nothing, "expected how to call centaur, found nothing") for nothing in ("", " ", "''")),
        ):
            code, said = self.refused("--program", program, "x")
            self.assertEqual((code, said.split(": error: ")[1]), (2, f"--program: {expected}"))

    def test_ray_is_looked_for_before_jobs(self):
        with mock.patch.object(subprocess, "run", side_effect=AssertionError):
            self.assertEqual(self.refused("x", ray=None), (1, "error: ray is missing: pip install ray"))

    def test_what_ray_refuses_is_one_line(self):
        program = f'{sys.executable} -c "pass"'
        self.assertEqual(self.refused("--program", program, "--address", "a:1", "x"), (1, "error: no cluster at a:1"))


if __name__ == "__main__":
    unittest.main()
