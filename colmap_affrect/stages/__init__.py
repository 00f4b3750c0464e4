"""The stages of a run: extract, pairs, match, verify, guide and map, one file each.

Beside these, ``one_image`` says what is done for one photograph, ``stationary`` what never moves;
``foreign`` takes over verified databases, ``descriptors`` matches those of databases. No stage
calls another one; ``pipeline`` and ``escalation`` do. Options that are not given are those on
record; ``overwrite`` discards what a stage left before, and later stages.
"""
