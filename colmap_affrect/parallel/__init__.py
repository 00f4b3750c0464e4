"""Where work is done: threads, a cluster, other processes."""
