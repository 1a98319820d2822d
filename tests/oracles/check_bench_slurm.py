"""bench.sbatch on a Slurm cluster of two nodes on this machine: `check_bench_slurm.py PROGRAM CAPTURE FOLDER`, as root.

First two scenes (links to one capture) with two variants at coarse settings, as an array of two tasks, one on each
node; both nodes claim to have a GPU. Then a training that would take a day with a time limit of three minutes, two of
them for its end: it must save a checkpoint, and resume from it when submitted again. Controller and nodes have their
files in FOLDER, and their own ports: an existing Slurm is not touched.
"""

import contextlib
import getpass
import json
import os
import pathlib
import secrets
import signal
import socket
import struct
import subprocess
import sys
import time

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
COARSE = ["--max-side", "48", "--iterations", "20", "--surface-iterations", "10", "--warmup", "10", "--triangles", "500",
          "--texture-size", "64", "--max-splats", "2000"]
ENDLESS = ["--no-mesh", "--max-side", "48", "--iterations", "10000000", "--max-splats", "500", "--checkpoint-every", "0", "--eval-every", "0"]
NODES = ["one", "two"]


def free_ports(count):
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [s.getsockname()[1] for s in sockets]


def run(*command, **options):
    return subprocess.run([str(word) for word in command], check=True, stdout=subprocess.PIPE, text=True, **options).stdout


@contextlib.contextmanager
def cluster(folder):
    """Starts a controller and two nodes; SLURM_CONF names their configuration."""
    (controller_port, *ports), host, user = free_ports(3), socket.gethostname(), getpass.getuser()
    munge = folder / "munge"
    for path in [munge, folder / "state"]:
        path.mkdir(mode=0o700)
    (munge / "key").touch(0o600)
    (munge / "key").write_bytes(secrets.token_bytes(128))
    settings = {
        "ClusterName": "centaur", "SlurmctldHost": f"{host}(127.0.0.1)", "SlurmctldPort": controller_port, "SlurmUser": user, "SlurmdUser": user,
        "AuthType": "auth/munge", "AuthInfo": f"socket={munge}/socket", "StateSaveLocation": folder / "state",
        "SlurmdSpoolDir": folder / "spool-%n", "SlurmctldPidFile": folder / "controller.pid", "SlurmdPidFile": folder / "%n.pid",
        "SlurmctldLogFile": folder / "controller.log", "SlurmdLogFile": folder / "%n.log",
        "ProctrackType": "proctrack/linuxproc", "TaskPlugin": "task/none", "MpiDefault": "none",
        "SelectType": "select/cons_tres", "SelectTypeParameters": "CR_Core", "GresTypes": "gpu", "SlurmdParameters": "config_overrides",
    }
    lines = [f"{name}={value}" for name, value in settings.items()]
    # As many resources as bench.sbatch asks for, whatever this machine has.
    lines += [f"NodeName={n} NodeHostname={host} NodeAddr=127.0.0.1 Port={p} CPUs=4 RealMemory=32768 Gres=gpu:1" for n, p in zip(NODES, ports)]
    lines.append(f"PartitionName=all Nodes={','.join(NODES)} Default=YES")
    (folder / "slurm.conf").write_text("\n".join(lines) + "\n")
    (folder / "gres.conf").write_text(f"NodeName={','.join(NODES)} Name=gpu File=/dev/null\n")
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    # In a folder where a login shell would not look.
    os.environ["PATH"] += ":/usr/sbin"
    daemons = [["munged", "--foreground", "--force", *(f"--{name}={munge}/{name.split('-')[0]}" for name in ["socket", "key-file", "log-file", "pid-file", "seed-file"])],
               ["slurmctld", "-D"], *(["slurmd", "-D", "-N", node] for node in NODES)]
    with contextlib.ExitStack() as stack:
        for daemon in daemons:
            with (folder / "daemons.out").open("a") as said:
                process = subprocess.Popen(daemon, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            if daemon[0] == "munged":
                wait_for("munge's socket", (munge / "socket").exists, 20)
        wait_for("two idle nodes", lambda: idle_nodes() == len(NODES), 60)
        yield


def idle_nodes():
    listed = subprocess.run(["sinfo", "--noheader", "--format=%D", "--states=idle"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True).stdout
    return int(listed.split()[0]) if listed.split() else 0


def wait_for(what, is_so, seconds):
    end = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() > end:
            raise TimeoutError(f"expected {what} within {seconds} s, found none")
        time.sleep(0.2)


def submit(program, folder, array, *options, time_limit=None):
    """Submits and waits; returns the output of the tasks, by task, and their final states."""
    # Options in addition to those of bench.sbatch, so that no files are left in the repository's folder.
    flags = ["--parsable", "--wait", f"--array={array}", f"--output={folder}/%A_%a.log", *([f"--time={time_limit}"] if time_limit else [])]
    environment = {**os.environ, "CENTAUR_PROGRAM": program}
    done = subprocess.run(["sbatch", *flags, "datasets-scripts/bench.sbatch", *map(str, options)],
                          cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, text=True)
    job = done.stdout.strip()
    said = {path.stem.split("_")[1]: path.read_text() for path in sorted(folder.glob(f"{job}_*.log"))}
    states = run("scontrol", "show", "job", job)
    return done.returncode, said, states


def check_array(program, folder, scenes):
    out = folder / "out"
    options = [scenes, "-o", out, "--variant", "hybrid", "--variant", "splats=--no-mesh", "--", *COARSE]
    status, said, states = submit(program, folder, "0-1", *options)
    assert status == 0 and len(said) == 2, (status, said)
    assert all(f" NodeList={node}\n" in states for node in NODES), states
    table = json.loads((out / "table.json").read_text())
    assert [len(v["rows"]) for v in table["variants"]] == [2, 2], table
    assert all(row["psnr"] > 5 for v in table["variants"] for row in v["rows"])
    made = {path: path.stat().st_mtime_ns for path in out.rglob("*.glb")}
    assert len(made) == 4, made
    status, said, _ = submit(program, folder, "0-1", *options)
    assert status == 0 and {path: path.stat().st_mtime_ns for path in made} == made, ("what is done is done", said)


def check_time_limit(program, folder, scenes):
    out = folder / "ended"
    options = [scenes, "-o", out, "--scenes", "one", "--", *ENDLESS]
    iterations = [0]
    for _ in range(2):
        status, said, states = submit(program, folder, "0", *options, time_limit="0:03:00")
        # Not killed: it ended in time, and reports that not all is done.
        assert status == 143 and "JobState=FAILED" in states, (status, states)
        assert said["0"].endswith("note: stopped; the same command goes on\n"), said
        (checkpoint,) = out.rglob("*.checkpoint")
        iterations.append(iteration(checkpoint))
    assert iterations == sorted(set(iterations)), iterations
    return iterations[1:]


def iteration(checkpoint):
    """Iteration at which the checkpoint, a safetensors file, was saved."""
    with checkpoint.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        metadata = json.loads(file.read(length))["__metadata__"]
    return json.loads(metadata["centaur_checkpoint"])["meta"]["iteration"]


def give_up(*_):
    raise TimeoutError("expected an end within twelve minutes, found none")


def main():
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(720)
    program, capture, folder = (pathlib.Path(argument).resolve() for argument in sys.argv[1:])
    scenes = folder / "scenes"
    scenes.mkdir(parents=True)
    for name in ["one", "two"]:
        os.symlink(capture, scenes / name)
    with cluster(folder):
        check_array(str(program), folder, scenes)
        first, second = check_time_limit(str(program), folder, scenes)
    print(f"two nodes, four jobs; time limits at iterations {first} and {second}: agreed")


if __name__ == "__main__":
    main()
