"""The stages of a run: extract, pairs, match, verify, escalate, guide and map, one file each.

They share ``context``; ``one_image`` says what is done for one photograph. Options that are not
given are those on record; ``overwrite`` discards what a stage left before, and later stages.
"""
