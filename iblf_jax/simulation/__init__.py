"""One run of a scenario: its definition and paths, the closed loop, signals and vector field,
integrators, accuracy, metrics and results.
"""
