"""Guarantees over sets: statements that are proved for all points of a box."""
