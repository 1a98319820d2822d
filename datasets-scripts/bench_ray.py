"""Runs the jobs of `centaur bench` on a Ray cluster, one task each, and makes the table.

  pip install ray
  python3 bench_ray.py [--address ADDRESS] [--gpus 1] [--cpus 2] DATASET -o OUT [options of centaur bench]

All nodes must see DATASET and OUT under the same paths and have `centaur` (or what --program says). A task that is lost with its
node is started again and goes on from its checkpoint; jobs that are done are not done again. On nodes of several GPUs a job has the one
that Ray assigned to it.
"""

import argparse
import os
import shlex
import subprocess
import sys

import assigned_adapter
from assigned_adapter import adapter_of


def ask(program, options, **pipes):
    """Runs `centaur bench` on this machine."""
    try:
        return subprocess.run([*program, "bench", *options], **pipes)
    except OSError as e:
        raise SystemExit(f"error: {program[0]}: {e.strerror}; put it into the PATH, or say with --program how to call it")


def open_jobs(program, options):
    """A command for each job that is not done."""
    listed = ask(program, with_option(options, "--list"), stdout=subprocess.PIPE, text=True)
    if listed.returncode:
        raise SystemExit(listed.returncode)
    # A line begins with the program's own path, which other nodes may have elsewhere, and `bench`.
    return [[*program, "bench", "--quiet", *shlex.split(line)[2:]] for line in listed.stdout.split("\n") if line]


def with_option(options, option):
    """Before the flags of `centaur train`."""
    end = options.index("--") if "--" in options else len(options)
    return [*options[:end], option, *options[end:]]


def run(program, command, folder):
    """Exit status of a job, the last line it said, and where. Its paths are relative to `folder`: a worker runs where its node began."""
    import ray

    context = ray.get_runtime_context()
    where = context.get_node_id()[:8]
    environment = dict(os.environ)
    gpus = context.get_accelerator_ids().get("GPU")
    try:
        os.chdir(folder)
        adapter = adapter_of(gpus[0] if gpus else None, program)
    except (LookupError, OSError, ValueError) as e:
        return 1, str(e), where
    if adapter:
        environment["CENTAUR_ADAPTER"] = adapter
        where += f" ({adapter})"
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    try:
        done = subprocess.run(command, env=environment, text=True, **pipes)
    except OSError as e:
        return 1, str(e), where
    return done.returncode, (done.stderr.strip().splitlines() or [""])[-1], where


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="centaur", help="how to call it (default: centaur)")
    parser.add_argument("--address", help="of the cluster (default: that of the environment, else this machine alone)")
    parser.add_argument("--gpus", type=float, default=1, help="of a job; parts share a GPU, 0 for none (default: 1)")
    parser.add_argument("--cpus", type=float, default=2, help="of a job (default: 2)")
    args, options = parser.parse_known_args(arguments)
    try:
        program = shlex.split(args.program)
    except ValueError as e:
        parser.error(f"--program: {e}: {args.program}")
    if not program or not program[0]:
        parser.error("--program: expected how to call centaur, found nothing")
    try:
        import ray
    except ImportError:
        raise SystemExit("error: ray is missing: pip install ray")
    jobs = open_jobs(program, options)
    try:
        ray.init(address=args.address, log_to_driver=False)
        has = ray.cluster_resources()
        for what, asked, flag in [("GPU", args.gpus, "--gpus"), ("CPU", args.cpus, "--cpus")]:
            if asked > has.get(what, 0):
                print(f"note: jobs wait for a node with {asked:g} {what}s, of which the cluster has {has.get(what, 0):g}: see {flag}", file=sys.stderr)
        # Nodes need not have these files.
        for module in [sys.modules[__name__], assigned_adapter]:
            ray.cloudpickle.register_pickle_by_value(module)
        task = ray.remote(num_gpus=args.gpus, num_cpus=args.cpus, max_retries=3)(run)
        names = {task.remote(program, job, os.getcwd()): job[job.index("--only") + 1] for job in jobs}
    except (OSError, RuntimeError, ValueError) as e:  # an address of no cluster, parts of GPUs that are not to be had
        raise SystemExit(f"error: {(str(e).strip().splitlines() or [type(e).__name__])[0]}")
    failed, pending = 0, list(names)
    while pending:
        (ready,), pending = ray.wait(pending, num_returns=1)
        try:
            status, message, node = ray.get(ready)
        except ray.exceptions.RayError as e:  # the node or the task is gone for good
            status, message, node = 1, str(e).strip().splitlines()[0], "unknown"
        failed += status != 0
        print(f"{len(jobs) - len(pending)}/{len(jobs)}  {names[ready]} on node {node}: {'ended' if status == 0 else message}", flush=True)
    if failed:
        raise SystemExit(f"{failed} of {len(jobs)} jobs failed")
    # A job that another runner is at ends here at once, and well.
    left = [job[job.index("--only") + 1] for job in open_jobs(program, options)]
    if left:
        raise SystemExit(f"{len(left)} of {len(jobs)} jobs are left to another runner, first {left[0]}: run again for the table of all")
    raise SystemExit(ask(program, with_option(options, "--table")).returncode)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        raise SystemExit("error: stopped; the same command goes on")
