"""Statistics of the control loop for the diagnostics, without allocation in the loop."""

from __future__ import annotations

LATENCY_BIN = 10_000
"""Width of a bin of the histogram of latencies [ns]."""
LATENCY_BINS = 5_000
"""Number of bins; the last one contains all longer latencies."""


class LoopMonitor:
    """Counts periods, missed periods and latencies of a loop."""

    def __init__(self) -> None:
        self.samples = 0
        self.missed = 0
        self.longest_latency = 0
        """[ns]."""
        self._latencies = [0] * (LATENCY_BINS + 1)
        self._latency_count = 0

    def count_sample(self, missed: int) -> None:
        """Counts one period with a command, and the periods without one before it."""
        self.samples += 1
        self.missed += missed

    def add_latency(self, latency: int) -> None:
        """Adds the time from the arrival of a state to the command that answers it [ns]."""
        latency = max(latency, 0)
        self._latencies[min(latency // LATENCY_BIN, LATENCY_BINS)] += 1
        self._latency_count += 1
        self.longest_latency = max(self.longest_latency, latency)

    @property
    def missed_share(self) -> float:
        """Share of the periods without a command of their own."""
        periods = self.samples + self.missed
        return self.missed / periods if periods else 0.0

    def latency_quantile(self, share: float) -> float:
        """The upper end of the bin that contains a quantile of the latencies [s]; 0 without any."""
        remaining = share * self._latency_count
        if not self._latency_count:
            return 0.0
        for index, count in enumerate(self._latencies[:-1]):
            remaining -= count
            if remaining <= 0:
                return (index + 1) * LATENCY_BIN * 1e-9
        return self.longest_latency * 1e-9
