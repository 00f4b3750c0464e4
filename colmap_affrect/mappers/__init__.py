"""Mappers: from verified pairs to models."""
