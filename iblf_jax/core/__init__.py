"""What everything stands on: components as pytrees, checks, small linear algebra, status flags,
tables of words, whole files.
"""
