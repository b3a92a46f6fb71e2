"""Fixed points of a map that changes little from one problem to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MEMORY = 5  # steps that the next one is extrapolated from
_APART = 1e-3  # what of them is told from the others, at the least


@dataclass
class Anderson:
    """Extrapolates x -> x + f(x) to f = 0 by the latest steps (Anderson 1965; [anderson1965]), those of an
    earlier problem among them."""

    steps: list[tuple[Floats, Floats]] = field(default_factory=list)  # of x and f, over the length of f's
    last: tuple[Floats, Floats] | None = None

    def begin(self) -> None:
        """A new problem, whose map is like the last one's."""
        self.last = None

    def forget(self) -> None:
        """A new problem, whose map is another."""
        self.last = None
        self.steps.clear()

    def next(self, x: Floats, f: Floats) -> Floats:
        """Where to look next, for what was found at x; all shape (n,)."""
        if self.last is not None:
            change = f - self.last[1]
            size = float(np.linalg.norm(change))
            if size > 0:
                self.steps.append(((x - self.last[0]) / size, change / size))
                del self.steps[:-_MEMORY]
        self.last = x, f
        if not self.steps:
            return x + f
        dx, df = (np.stack(part, axis=1) for part in zip(*self.steps, strict=True))
        return np.asarray(x + f - (dx + df) @ np.linalg.lstsq(df, f, rcond=_APART)[0])
