"""A law outside of the package: against another simulator's robot.  Of this folder users call `ij.cosimulate`."""
