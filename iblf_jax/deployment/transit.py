"""Commands that a law has sent and that reach the robot later."""

from __future__ import annotations

import numpy as np


class CommandsInTransit:
    """The commands of a run in the order in which they were sent; each arrives `delay` later."""

    def __init__(self, delay: float) -> None:
        """`delay` of the transport [s], >= 0."""
        self.delay = delay
        self.commands: list[np.ndarray] = []
        self.times: list[float] = []
        """Time of arrival of each command [s]."""
        self.arrived = 0
        """Number of commands that have arrived."""

    def __len__(self) -> int:
        """Number of commands that were sent."""
        return len(self.commands)

    def send(self, t: float, command: np.ndarray) -> None:
        """Sends a command, (n,) [N m], at time t [s]."""
        self.commands.append(command)
        self.times.append(t + self.delay)

    def next_arrival(self, otherwise: float) -> float:
        """Time at which the next command arrives [s]; `otherwise` if none is in transit."""
        if self.arrived < len(self.commands):
            return self.times[self.arrived]
        return otherwise

    def received(self, until: float) -> np.ndarray | None:
        """The newest of the commands that arrive by a time [s]; None if none arrives.  They are in
        transit no longer.
        """
        newest = None
        while self.arrived < len(self.commands) and self.times[self.arrived] <= until:
            newest = self.commands[self.arrived]
            self.arrived += 1
        return newest
