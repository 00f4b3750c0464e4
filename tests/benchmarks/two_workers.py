"""Throughput of extraction on two workers of one core each, over that on one. Usage:

    python tests/benchmarks/two_workers.py --image-path PHOTOS --rounds 5

Images are worked on by clusters of one and of two workers in turn. On a machine that is busy
otherwise only the processor time per image tells: it should not grow with the second worker.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from colmap_affrect.images.photographs import list_images
from colmap_affrect.parallel.cluster import Cluster, connected
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import Inputs, extract_images
from colmap_affrect.stages.one_image import ImageExtractor, prepare

sys.path.insert(0, str(Path(__file__).parents[1]))

from local_cluster import local_cluster
from machine import describe_machine


def seconds(
    cluster: Cluster, extractor: ImageExtractor, inputs: Inputs, names: Sequence[str]
) -> tuple[float, float]:
    """Extract images; return the seconds taken and those of the workers' processors."""
    client = cluster._client
    used, start = sum(client.run(time.process_time).values()), time.perf_counter()
    images = [(name, 0) for name in names]
    with TemporaryDirectory() as folder:
        context = Context(Workspace(Path(folder)), executor=cluster)
        for _ in extract_images(context, inputs, extractor, images):
            pass
    wall = time.perf_counter() - start
    return wall, sum(client.run(time.process_time).values()) - used


def main() -> None:
    """Print the ratio of every round and the median."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--image-path", type=Path, required=True)
    parser.add_argument("--max-num-images", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    inputs = Inputs.of(options.image_path)
    names = list_images(options.image_path)[: options.max_num_images]
    extractor = prepare(load_recipe("default").extraction)
    ratios, processor_ratios = [], []
    with ExitStack() as stack:
        clusters = []
        for count in (1, 2):
            folder = Path(stack.enter_context(TemporaryDirectory()))
            address = stack.enter_context(local_cluster(folder, count))
            clusters.append(stack.enter_context(connected(address)))
            clusters[-1]._client.wait_for_workers(count)
            seconds(clusters[-1], extractor, inputs, names[:count])
        print(describe_machine())
        for _ in range(options.rounds):
            one, two = (seconds(item, extractor, inputs, names) for item in clusters)
            ratios.append(one[0] / two[0])
            processor_ratios.append(one[1] / two[1])
            print(f"throughput {ratios[-1]:.2f}, images per processor {processor_ratios[-1]:.2f}")
    print(f"median {median(ratios):.2f}, per processor {median(processor_ratios):.2f}")


if __name__ == "__main__":
    main()
