"""Proofs: statements about all states of a level set and all parameters of a box.

`arms.arm_problem` makes a `LevelSetProblem` of a rigid arm under the backstepping law, and
`search.search` decides by interval arithmetic and bisection whether V_w decreases everywhere on its
level set.
"""
