r"""Reconstruct on Kubernetes: start workers as pods, run colmap-affrect on them, end them.

Everything after ``--`` goes to ``colmap-affrect run``, which runs on this machine. Needs ``pip
install dask-kubernetes`` and Dask's operator in the Kubernetes cluster, and photographs and results
on a volume that this machine mounts at the same path. Usage:

    python on_kubernetes.py --image IMAGE --workers 20 --claim photographs -- \
        --image-path /shared/photos --output-path /shared/out
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from dask_kubernetes.operator import KubeCluster, make_cluster_spec

# What workers load before they are asked
PRELOADED = "--preload colmap_affrect.stages.match --preload torch"


def main() -> int:
    """Return the exit code of colmap-affrect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--image",
        required=True,
        help="container image with colmap-affrect, see docs/cluster.md",
    )
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--cores", type=int, default=8, help="of each worker")
    parser.add_argument("--memory", default="16Gi", help="of each worker")
    parser.add_argument(
        "--claim",
        required=True,
        help="persistent volume claim with photographs and results",
    )
    parser.add_argument(
        "--mount-path", default="/shared", help="of the claim in the workers"
    )
    parser.add_argument("arguments", nargs="+", help="of colmap-affrect run, after --")
    options = parser.parse_args()
    spec = make_cluster_spec(
        name="colmap-affrect",
        image=options.image,
        n_workers=options.workers,
        worker_command=f"dask worker --nthreads {options.cores} {PRELOADED}",
    )
    # The command 'dask-scheduler' that dask-kubernetes starts is no more since distributed 2026.
    scheduler = spec["spec"]["scheduler"]["spec"]["containers"][0]
    scheduler["args"] = ["dask", "scheduler"]
    pod = spec["spec"]["worker"]["spec"]
    container = pod["containers"][0]
    amount = {"cpu": str(options.cores), "memory": options.memory}
    container["resources"] = {"requests": amount, "limits": amount}
    claim = {"claimName": options.claim}
    pod["volumes"] = [{"name": "shared", "persistentVolumeClaim": claim}]
    container["volumeMounts"] = [{"name": "shared", "mountPath": options.mount_path}]
    with KubeCluster(custom_cluster_spec=spec) as cluster:
        cluster.wait_for_workers(1)
        address = cluster.scheduler_address
        command = ["colmap-affrect", "run", *options.arguments, "--scheduler", address]
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
