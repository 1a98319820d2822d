"""Errors of bench_ray.py for wrong calls, and its handling of job results, without Ray: python3 -m unittest discover
datasets-scripts"""

import contextlib
import io
import subprocess
import sys
import tempfile
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
        """Exit status and last line of output."""
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


class RayError(Exception):
    pass


class RayTaskError(RayError):
    pass


# A program with two open jobs, and a table.
PROGRAM = """
import sys
if "--list" in sys.argv:
    print("centaur bench --only a/one-0\\ncentaur bench --only a/two-0")
"""


class Jobs(unittest.TestCase):
    def bench(self, *endings, nodes=({"Alive": True, "Resources": {"CPU": 2.0, "GPU": 1.0}},)):
        """Exit status and output if tasks end one after the other with these results of `bench_ray.run` or Ray
        errors."""
        endings, started, said = iter(endings), [], io.StringIO()

        def remote(program, job, folder):
            started.append(job[-1])
            return len(started)

        def get(task):
            ending = next(endings)
            if isinstance(ending, Exception):
                raise ending
            return ending

        ray = types.SimpleNamespace(
            init=lambda **_: None,
            nodes=lambda: nodes,
            cloudpickle=types.SimpleNamespace(register_pickle_by_value=lambda _: None),
            remote=lambda **_: lambda _: types.SimpleNamespace(remote=remote),
            wait=lambda tasks, num_returns, timeout: (tasks[:1], tasks[1:]),
            get=get,
            exceptions=types.SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError),
        )
        with tempfile.TemporaryDirectory() as folder, mock.patch.dict(sys.modules, ray=ray), contextlib.redirect_stdout(said):
            program = Path(folder, "program.py")
            program.write_text(PROGRAM)
            with self.assertRaises(SystemExit) as end:
                bench_ray.main(["--program", f"{sys.executable} {program}", "--retry-after", "0.01", "x", "-o", "y"])
        self.assertEqual(list(endings), [])
        return end.exception.code, said.getvalue().splitlines(), started

    def test_jobs_of_another_runner_are_asked_for_until_they_are_done(self):
        elsewhere, done = (3, "error: 1 job left to another runner", "n1"), (0, "", "n2")
        code, said, started = self.bench(elsewhere, done, elsewhere, elsewhere, done)
        self.assertEqual(code, 0)
        left = "0/2  a/one-0 on node n1: left to another runner; again every 0.01 s"
        self.assertEqual(said, [left, "1/2  a/two-0 on node n2: ended", "2/2  a/one-0 on node n2: ended"])
        self.assertEqual(started, ["a/one-0", "a/two-0", *["a/one-0"] * 3])

    def test_failures_have_their_reasons(self):
        task = RayTaskError("ray::run() (pid=7, ip=10.0.0.1)\n  File a.py, line 1\nValueError: no such thing\n")
        code, said, _ = self.bench(task, RayError("The worker died unexpectedly.\nMore of it."))
        self.assertEqual(code, "2 of 2 jobs failed")
        reasons = ["ValueError: no such thing", "The worker died unexpectedly."]
        self.assertEqual([line.split(" on node unknown: ")[1] for line in said], reasons)

    def test_what_no_node_has_is_an_error(self):
        def node(cpus, gpus, is_alive=True):
            return {"Alive": is_alive, "Resources": {"CPU": cpus, **({"GPU": gpus} if gpus else {})}}

        # Only two nodes together have the resources, and a third is gone.
        code, said, started = self.bench(nodes=[node(2.0, 0), node(1.0, 1.0), node(8.0, 8.0, False)])
        self.assertEqual(
            code, "error: expected a node with 1 GPUs, 2 CPUs, found 0 GPUs, 2 CPUs; 1 GPUs, 1 CPUs: see --gpus and --cpus"
        )
        self.assertEqual((said, started), ([], []))


if __name__ == "__main__":
    unittest.main()
