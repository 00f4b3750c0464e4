"""The paper's evaluations on its datasets, and the same protocols on pairs of one's own."""
