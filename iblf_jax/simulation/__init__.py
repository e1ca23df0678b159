"""What one run is: the scenario and its paths, the closed loop, integrators, modes and accuracy, metrics, results."""
