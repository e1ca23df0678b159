"""The modules of a generated ROS 2 package.  They import each other, the standard library, rclpy
and messages only, so that the package runs without iblf_jax.
"""
