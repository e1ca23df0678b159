"""Foundations of the package: components as pytrees, checks of arguments, small linear algebra,
status flags, caches, warnings and tables.
"""
