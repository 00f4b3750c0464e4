"""What a command works with: photographs, options on record, stores, the view graph, the database.

``context`` holds it all; ``view_graph`` is what the database says of images and verified pairs;
``database_export`` puts into the database what is stored.
"""
