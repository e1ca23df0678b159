"""The law of a scenario as a ROS 2 package, `ij.export(..., target="ros2")`, and a simulated robot
for it.

`package` writes the package from `templates/`.  The modules in `node/` are copied into it and run
on the robot without iblf_jax.  `simulated_robot` is a robot for tests on one machine, and `demo`
runs both.  `ros2_control` writes a controller plugin of ros2_control around the same law, and
`bags` reads recordings.
"""
