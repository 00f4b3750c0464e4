"""The output folder: record of options, stores, files that change as a whole, report."""
