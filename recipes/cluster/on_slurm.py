"""Reconstruct on a Slurm cluster: start workers as jobs, run colmap-affrect on them, end them.

Everything after ``--`` goes to ``colmap-affrect run``. Needs ``pip install dask-jobqueue``. Usage:

    python on_slurm.py --jobs 20 --queue short -- --image-path /shared/photos --output-path out
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from dask_jobqueue import SLURMCluster

# What workers load before they are asked
PRELOADED = ["--preload", "colmap_affrect.stages.match", "--preload", "torch"]


def main() -> int:
    """Return the exit code of colmap-affrect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=4)
    parser.add_argument("--cores", type=int, default=8, help="of each job")
    parser.add_argument("--memory", default="16 GB", help="of each job")
    parser.add_argument("--queue", help="partition")
    parser.add_argument("--account")
    parser.add_argument("--walltime", default="04:00:00")
    parser.add_argument("arguments", nargs="+", help="of colmap-affrect run, after --")
    options = parser.parse_args()
    with SLURMCluster(
        queue=options.queue,
        account=options.account,
        cores=options.cores,
        processes=1,  # a worker works on as many images as it has cores
        memory=options.memory,
        walltime=options.walltime,
        worker_extra_args=PRELOADED,
    ) as cluster:
        cluster.scale(jobs=options.jobs)
        cluster.wait_for_workers(1)
        address = cluster.scheduler_address
        command = ["colmap-affrect", "run", *options.arguments, "--scheduler", address]
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
