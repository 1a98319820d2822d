"""bench_ray.py on a cluster of two nodes on this machine: `check_bench_ray.py "PROGRAM" CAPTURE FOLDER`.

First two scenes (links to one capture) with two variants at coarse settings; each node takes one job at a time, so both
must work. Then two jobs of a fictitious program on the second node, which claims to have two GPUs: each job must get
its own. Then a job that fails once, and one that kills the worker above it and still holds the job when Ray has
restarted it: it must be waited for.
"""

import contextlib
import io
import json
import os
import pathlib
import signal
import sys

import ray
from ray.cluster_utils import Cluster

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "datasets-scripts"))
import bench_ray  # noqa: E402

COARSE = ["--max-side", "48", "--iterations", "20", "--surface-iterations", "10", "--warmup", "10", "--triangles", "500",
          "--texture-size", "64", "--max-splats", "2000"]


# Both jobs wait until both run. Vulkan's order differs from that of NVIDIA's tools.
STAND_IN = """
import json, os, pathlib, sys, time
folder = pathlib.Path(__file__).parent
if sys.argv[1] == "devices":
    buses = ["0000:c1:00.0", "0000:41:00.0"]
    print(json.dumps([{"index": i, "name": "A GPU", "kind": "DiscreteGpu", "pci_bus_id": bus} for i, bus in enumerate(buses)]))
elif "--list" in sys.argv:
    for job in "a/one-0", "a/two-0":
        if not (folder / job.replace("/", "-")).with_suffix(".json").exists():
            print("centaur bench --only", job)
elif "--only" in sys.argv:
    job = folder / sys.argv[-1].replace("/", "-")
    job.with_suffix(".json").write_text(json.dumps([os.environ["CUDA_VISIBLE_DEVICES"], os.environ.get("CENTAUR_ADAPTER")]))
    end = time.monotonic() + 120
    while len(list(folder.glob("*.json"))) < 2:
        if time.monotonic() > end:
            sys.exit("error: expected another job at the same time, found none in two minutes")
        time.sleep(0.1)
"""
UNLUCKY = """
import fcntl, os, pathlib, signal, sys, time
folder = pathlib.Path(__file__).parent
if "--list" in sys.argv:
    for job in "a/fails-0", "a/killed-0":
        if not (folder / job.replace("/", "-")).with_suffix(".json").exists():
            print("centaur bench --only", job)
elif "--only" in sys.argv:
    job = folder / sys.argv[-1].replace("/", "-")
    is_first = not job.with_suffix(".lock").exists()
    lock = job.with_suffix(".lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        job.with_suffix(".asked").touch()
        sys.exit(3)
    if is_first and "fails" in job.name:
        sys.exit("error: this once")
    if is_first:
        worker = os.getppid()
        os.setsid()  # Ray ends what is left of a worker's group
        os.kill(worker, signal.SIGKILL)
        end = time.monotonic() + 120
        while not job.with_suffix(".asked").exists() and time.monotonic() < end:
            time.sleep(0.1)
        sys.exit("error: of this nobody hears")
    job.with_suffix(".json").touch()
"""
NVIDIA_SMI = "#!/bin/sh\nprintf '0, GPU-aa, 00000000:41:00.0\\n1, GPU-bb, 00000000:C1:00.0\\n'\n"


def bench(arguments, code=0):
    """Output of bench_ray.py, after checking its exit status."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            bench_ray.main(arguments)
        except SystemExit as end:
            assert end.code == code, (end.code, said.getvalue())
    ray.shutdown()
    print(said.getvalue())
    return said.getvalue()


def check_gpus(address, folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    bench(["--program", f"{sys.executable} {folder / 'stand_in.py'}", "--address", address, "--gpus", "1", "--cpus", "0.5", "none", "-o", "none"])
    adapters = dict(json.loads(path.read_text()) for path in folder.glob("*.json"))
    assert adapters == {"0": "0000:41:00.0", "1": "0000:c1:00.0"}, adapters


def check_unlucky(address, folder):
    folder.mkdir()
    (folder / "unlucky.py").write_text(UNLUCKY)
    arguments = ["--program", f"{sys.executable} {folder / 'unlucky.py'}", "--address", address, "--gpus", "0", "--cpus", "0.5",
                 "--retry-after", "1", "none", "-o", "none"]
    lines = bench(arguments, "1 of 2 jobs failed").splitlines()
    of = lambda job: [line.split(": ", 1)[1] for line in lines if f"  a/{job}-0 on node " in line]
    assert of("fails") == ["error: this once"], lines
    assert of("killed") == ["left to another runner; again every 1 s", "ended"], lines
    lines = bench(arguments).splitlines()
    assert (of("fails"), of("killed")) == (["ended"], []), lines


def give_up(*_):
    raise TimeoutError("expected an end within ten minutes, found none")


def main():
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(600)
    program, capture, folder = sys.argv[1], pathlib.Path(sys.argv[2]).resolve(), pathlib.Path(sys.argv[3]).resolve()
    scenes, out = folder / "scenes", folder / "out"
    scenes.mkdir(parents=True)
    for name in ["one", "two"]:
        os.symlink(capture, scenes / name)
    # Found by the nodes, which are started with this path.
    gpus = folder / "gpus"
    gpus.mkdir()
    (gpus / "nvidia-smi").write_text(NVIDIA_SMI)
    (gpus / "nvidia-smi").chmod(0o755)
    os.environ["PATH"] = f"{gpus}:{os.environ['PATH']}"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "num_gpus": 0})
    cluster.add_node(num_cpus=1, num_gpus=2)
    options = [str(scenes), "-o", str(out), "--variant", "hybrid", "--variant", "splats=--no-mesh", "--", *COARSE]
    said = bench(["--program", program, "--address", cluster.address, "--gpus", "0", "--cpus", "1", *options])
    nodes = {line.split(" on node ")[1] for line in said.splitlines()}
    assert "4/4" in said and len(nodes) == 2, nodes
    table = json.loads((out / "table.json").read_text())
    assert [len(v["rows"]) for v in table["variants"]] == [2, 2]
    assert all(row["psnr"] > 5 for v in table["variants"] for row in v["rows"])
    assert bench_ray.open_jobs(program.split(), options) == [], "what is done is done"
    check_gpus(cluster.address, gpus)
    check_unlucky(cluster.address, folder / "unlucky")
    cluster.shutdown()
    print("two nodes, four jobs; two GPUs, a job each; a job that failed, one whose worker was killed: agreed")


if __name__ == "__main__":
    main()
