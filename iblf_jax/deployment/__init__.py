"""A law outside of the package: against another simulator's robot (`ij.cosimulate`), and as code of
its own (`ij.export`).

`export` writes what `control_law` (one sample of a law) and `loop_program` (one step of a closed
loop) give as scalar programs.  `write_c` and `write_loop` make C of them by the generator of the
native backend, `fmu` packs it for other simulators; templates stand in `c/`.
"""
