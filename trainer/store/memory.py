"""Peak memory of this process as the system reports it, at the end of each stage and of the whole run."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

_STATUS = Path("/proc/self/status")


class PeakMemory:
    """Peak resident memory of the process, MB (2²⁰ bytes): what `/usr/bin/time -v` and VmHWM say.

    A stage's figure is the peak until its end; it is higher than the one before where the stage needed more
    than all that came earlier. On Windows Python cannot tell, and there is none.
    """

    def __init__(self) -> None:
        self.by_stage: dict[str, int] = {}
        self._earlier = 0

    def end(self, stage: str) -> None:
        """A stage ends."""
        if peak := round(_peak_mb()):
            self.by_stage[stage] = max(peak, self.by_stage.get(stage, 0))

    def peak(self) -> int | None:
        """Of the process and of earlier sessions of the same run; None where it is unknown."""
        return max(round(_peak_mb()), self._earlier) or None

    def restore(self, by_stage: Mapping[str, int], peak: int | None) -> None:
        """Take over the peaks of an earlier session of the same run."""
        for stage, earlier in by_stage.items():
            self.by_stage[stage] = max(earlier, self.by_stage.get(stage, 0))
        self._earlier = max(self._earlier, peak or 0)


def _peak_mb() -> float:
    """Peak since the process began; 0 where it is unknown.

    On Linux not `getrusage`, whose figure begins with what the parent held when it started this process.
    """
    if sys.platform == "win32":
        return 0.0
    if sys.platform == "linux":
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
