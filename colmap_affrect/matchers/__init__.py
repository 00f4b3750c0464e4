"""Matchers: which features of two images show the same."""
