"""Which photographs does each method register: run several methods on one set, and compare."""
