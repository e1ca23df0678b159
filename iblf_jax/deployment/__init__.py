"""A law outside of the package: with the robot of another simulator (`ij.cosimulate`), and as
generated code (`ij.export`).

`control_law` (one sample of a law) and `loop_program` (one step of a closed loop) build scalar
programs.  `write_c` and `write_loop` translate them to C with the generator of the native backend,
and `fmu` packages this code for other simulators.  The templates are in `c/`.
`ros2/` has what ROS 2 needs.
"""

from typing import TYPE_CHECKING

from iblf_jax.core.first_use import on_first_use as _on_first_use

if TYPE_CHECKING:
    from iblf_jax.deployment.ros2.bags import bag_log as bag_log
    from iblf_jax.deployment.ros2.bags import read_bag as read_bag
    from iblf_jax.deployment.ros2.robot_motion import RobotMotion as RobotMotion
    from iblf_jax.deployment.ros2.simulated_robot import SimulatedRobot as SimulatedRobot
    from iblf_jax.deployment.ros2.simulated_robot import robot_node as robot_node

__getattr__, __dir__ = _on_first_use(
    __name__,
    {
        "bag_log": ("iblf_jax.deployment.ros2.bags", "bag_log"),
        "read_bag": ("iblf_jax.deployment.ros2.bags", "read_bag"),
        "robot_node": ("iblf_jax.deployment.ros2.simulated_robot", "robot_node"),
        "RobotMotion": ("iblf_jax.deployment.ros2.robot_motion", "RobotMotion"),
        "SimulatedRobot": ("iblf_jax.deployment.ros2.simulated_robot", "SimulatedRobot"),
    },
)
