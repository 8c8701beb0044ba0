"""Peak memory of this process, of the whole run and of each of its stages."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class PeakMemory:
    """Peak resident memory by stage, MB (2²⁰ bytes).

    Linux can forget a peak, so that every stage has its own. Elsewhere a stage's figure is the peak of the
    process until the stage's end; on Windows Python cannot tell, and there is none.
    """

    def __init__(self) -> None:
        self.by_stage: dict[str, int] = {}
        self._running: dict[str, float] = {}
        self._highest = 0.0

    def begin(self, stage: str) -> None:
        """A stage begins; stages may lie in one another."""
        self._look()
        _forget()
        self._running[stage] = 0.0

    def end(self, stage: str) -> None:
        """It ends; of a stage that comes again the higher peak counts."""
        self._look()
        peak = round(self._running.pop(stage))
        if peak:
            self.by_stage[stage] = max(peak, self.by_stage.get(stage, 0))

    def peak(self) -> int | None:
        """Of the process so far, all stages and what lies between them; None where it cannot be told."""
        self._look()
        return round(self._highest) or None

    def restore(self, by_stage: Mapping[str, int], peak: int | None) -> None:
        """Take over the peaks of an earlier session of the same run."""
        for stage, earlier in by_stage.items():
            self.by_stage[stage] = max(earlier, self.by_stage.get(stage, 0))
        self._highest = max(self._highest, peak or 0)

    def _look(self) -> None:
        now = _peak_mb()
        self._highest = max(self._highest, now)
        for stage, peak in self._running.items():
            self._running[stage] = max(peak, now)


def _peak_mb() -> float:
    """Peak since the process began, or since it was last forgotten; 0 where it cannot be told."""
    if sys.platform == "win32":
        return 0.0
    if sys.platform == "linux":
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def _forget() -> None:
    """Let the peak start anew from what is in use now, where the system allows it."""
    try:
        if sys.platform == "linux":
            _CLEAR.write_text("5", encoding="ascii")  # proc(5): resets VmHWM
    except OSError:
        return  # a container that forbids it; the peaks then never fall, as on other systems
