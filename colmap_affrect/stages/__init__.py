"""The stages of a run: extract, pairs, match, verify, guide and map, one file each.

No stage calls another one; ``pipeline`` and ``escalation`` do. ``one_image``
says what is done for one photograph. Options that are not given are those on record; ``overwrite``
discards what a stage left before, and later stages.
"""
