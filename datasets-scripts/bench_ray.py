"""Runs the jobs of `centaur bench` on a Ray cluster, one task each, and makes the table.

  pip install ray
  python3 bench_ray.py [--address ADDRESS] [--gpus 1] [--cpus 2] DATASET -o OUT [options of centaur bench]

All nodes must see DATASET and OUT under the same paths and have `centaur` (or the program given by --program). A task
that is lost with its node is restarted and resumes from its checkpoint; finished jobs are not repeated. Jobs held by
another runner, such as a process left behind by a killed worker, are tried again until they are done. On nodes with
several GPUs a job uses the one that Ray assigned to it.
"""

import argparse
import os
import shlex
import subprocess
import sys
import time

import assigned_adapter
from assigned_adapter import adapter_of

# Exit status of `centaur bench` if another runner holds the job.
ELSEWHERE = 3


def ask(program, options, **pipes):
    """Runs `centaur bench` on this machine and returns its output."""
    try:
        return subprocess.run([*program, "bench", *options], **pipes)
    except OSError as e:
        raise SystemExit(f"error: {program[0]}: {e.strerror}; put it into the PATH, or say with --program how to call it")


def open_jobs(program, options):
    """A command for each unfinished job."""
    listed = ask(program, with_option(options, "--list"), stdout=subprocess.PIPE, text=True)
    if listed.returncode:
        raise SystemExit(listed.returncode)
    # A line begins with the program's own path, which can differ on other nodes, and `bench`.
    return [[*program, "bench", "--quiet", *shlex.split(line)[2:]] for line in listed.stdout.split("\n") if line]


def with_option(options, option):
    """Inserts an option before the flags of `centaur train`."""
    end = options.index("--") if "--" in options else len(options)
    return [*options[:end], option, *options[end:]]


def run(program, command, folder):
    """Runs a job; returns exit status, last line of output, and node. Paths are relative to `folder`: a worker has its
    node's folder."""
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
        done = subprocess.run(command, env=environment, text=True, errors="replace", **pipes)
    except OSError as e:
        return 1, str(e), where
    return done.returncode, (done.stderr.strip().splitlines() or [""])[-1], where


def ensure_resources(nodes, asked):
    """Stops unless a single node has all resources of a job, {resource: amount}: otherwise the job would wait
    forever."""
    has = [node["Resources"] for node in nodes if node["Alive"]]
    if any(all(node.get(what, 0) >= much for what, much in asked.items()) for node in has):
        return
    words = [", ".join(f"{of.get(what, 0):g} {what}s" for what in asked) for of in (asked, *has)]
    raise SystemExit(f"error: expected a node with {words[0]}, found {'; '.join(sorted(set(words[1:]))) or 'none'}: see --gpus and --cpus")


def reason(error):
    """Reason of a Ray error: the last line if a task raised it, else the first line about the lost node or worker."""
    import ray

    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[-1 if isinstance(error, ray.exceptions.RayTaskError) else 0]


def do_all(start, jobs, retry_after):
    """Does the jobs as tasks returned by `start(job)`, and retries those held by another runner after some seconds.
    Returns the number of failures."""
    import ray

    running, waiting, said, failed, ended = {start(job): job for job in jobs}, [], set(), 0, 0
    while running or waiting:
        soon = max(0, waiting[0][0] - time.monotonic()) if waiting else None
        if running:
            ready, _ = ray.wait(list(running), num_returns=1, timeout=soon)
        else:
            time.sleep(soon)
            ready = []
        while waiting and waiting[0][0] <= time.monotonic():
            _, job = waiting.pop(0)
            running[start(job)] = job
        for task in ready:
            job = running.pop(task)
            name = name_of(job)
            try:
                status, message, node = ray.get(task)
            except ray.exceptions.RayError as e:  # the node or the task is lost for good
                status, message, node = 1, reason(e), "unknown"
            if status == ELSEWHERE:
                waiting.append((time.monotonic() + retry_after, job))
                if name not in said:
                    print(f"{ended}/{len(jobs)}  {name} on node {node}: left to another runner; again every {retry_after:g} s", flush=True)
                said.add(name)
                continue
            ended += 1
            failed += status != 0
            print(f"{ended}/{len(jobs)}  {name} on node {node}: {'ended' if status == 0 else message}", flush=True)
    return failed


def name_of(job):
    """VARIANT/SCENE-SEED of a job's command."""
    return job[job.index("--only") + 1]


def seconds(text):
    """Parses --retry-after."""
    if not 0 <= (value := float(text)) <= 86400:
        raise ValueError
    return value


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="centaur", help="command to run centaur (default: centaur)")
    parser.add_argument("--address", help="address of the cluster (default: that of the environment, else this machine alone)")
    parser.add_argument("--gpus", type=float, default=1, help="GPUs per job; with a fraction jobs share a GPU, 0 for none (default: 1)")
    parser.add_argument("--cpus", type=float, default=2, help="CPUs per job (default: 2)")
    parser.add_argument(
        "--retry-after", type=seconds, default=45, metavar="SECONDS", help="delay before retrying jobs held by another runner (default: 45)"
    )
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
        if jobs:
            ensure_resources(ray.nodes(), {"GPU": args.gpus, "CPU": args.cpus})
        # Nodes need not have these files.
        for module in [sys.modules[__name__], assigned_adapter]:
            ray.cloudpickle.register_pickle_by_value(module)
        task = ray.remote(num_gpus=args.gpus, num_cpus=args.cpus, max_retries=3)(run)
        failed = do_all(lambda job: task.remote(program, job, os.getcwd()), jobs, args.retry_after)
    except (OSError, RuntimeError, ValueError) as e:  # no cluster at this address, or fractions of GPUs that Ray does not allow
        raise SystemExit(f"error: {(str(e).strip().splitlines() or [type(e).__name__])[0]}")
    if failed:
        raise SystemExit(f"{failed} of {len(jobs)} jobs failed")
    raise SystemExit(ask(program, with_option(options, "--table")).returncode)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        raise SystemExit("error: stopped; the same command goes on")
