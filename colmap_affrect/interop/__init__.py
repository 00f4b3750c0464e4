"""Other programs' files and functions."""
