"""The law of a scenario as a ROS 2 package: `ij.export(..., target="ros2")`.

`package` writes the package from `templates/`.  The modules in `node/` are copied into it and run
on the robot without iblf_jax.
"""
