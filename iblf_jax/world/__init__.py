"""What a controller acts on: robots, references, bounds, regions and disturbances."""
