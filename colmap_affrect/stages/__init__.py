"""The stages of a run: extract, pairs, match, verify, escalate, guide and map, one file each.

They share ``context``; ``one_image`` and ``one_pair`` say what is done for one photograph or pair.
"""
