"""What acts on a robot: barriers, control laws, disturbance observers, sensors and actuators."""
