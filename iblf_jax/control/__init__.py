"""What acts on a robot: barriers and decays, control laws, disturbance observers, sensors and
actuators.
"""
