"""What one run is: scenario and paths, the closed loop, its signals and vector field, integrators,
accuracy, metrics, results.
"""
