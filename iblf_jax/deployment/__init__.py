"""A law outside of the package: with the robot of another simulator (`ij.cosimulate`), and as
generated code (`ij.export`).

`control_law` (one sample of a law) and `loop_program` (one step of a closed loop) build scalar
programs.  `write_c` and `write_loop` translate them to C with the generator of the native backend,
and `fmu` packages this code for other simulators.  The templates are in `c/`.
`ros2/` has what ROS 2 needs.
"""

from iblf_jax.core.first_use import on_first_use as _on_first_use

__getattr__, __dir__ = _on_first_use(
    __name__,
    {
        "bag_log": ("iblf_jax.deployment.ros2.bags", "bag_log"),
        "read_bag": ("iblf_jax.deployment.ros2.bags", "read_bag"),
    },
)
