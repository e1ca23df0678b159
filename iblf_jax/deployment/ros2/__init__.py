"""The law of a scenario on a robot with ROS 2, and a simulated robot for it."""
