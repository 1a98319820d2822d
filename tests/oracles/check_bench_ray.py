"""bench_ray.py on a cluster of two nodes on this machine: `check_bench_ray.py "PROGRAM" CAPTURE FOLDER`.

Two scenes (links to one capture) times two variants, coarse; each node takes one job at a time, so both must work.
"""

import contextlib
import io
import json
import os
import pathlib
import sys

import ray
from ray.cluster_utils import Cluster

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "datasets-scripts"))
import bench_ray  # noqa: E402

COARSE = ["--max-side", "48", "--iterations", "20", "--surface-iterations", "10", "--warmup", "10", "--triangles", "500",
          "--texture-size", "64", "--max-splats", "2000"]


def main():
    program, capture, folder = sys.argv[1], pathlib.Path(sys.argv[2]).resolve(), pathlib.Path(sys.argv[3]).resolve()
    scenes, out = folder / "scenes", folder / "out"
    scenes.mkdir(parents=True)
    for name in ["one", "two"]:
        os.symlink(capture, scenes / name)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    options = [str(scenes), "-o", str(out), "--variant", "hybrid", "--variant", "splats=--no-mesh", "--", *COARSE]
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            bench_ray.main(["--program", program, "--address", cluster.address, "--gpus", "0", "--cpus", "1", *options])
        except SystemExit as end:
            assert end.code == 0, end.code
    print(said.getvalue())
    nodes = {line.split(" on node ")[1] for line in said.getvalue().splitlines()}
    assert "4/4" in said.getvalue() and len(nodes) == 2, nodes
    table = json.loads((out / "table.json").read_text())
    assert [len(v["rows"]) for v in table["variants"]] == [2, 2]
    assert all(row["psnr"] > 5 for v in table["variants"] for row in v["rows"])
    assert bench_ray.open_jobs(program.split(), options) == [], "what is done is done"
    ray.shutdown()
    cluster.shutdown()
    print("two nodes, four jobs: agreed")


if __name__ == "__main__":
    main()
