"""A measured figure with the limit (or the rival of the same run) it is judged against."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass


def number(run: Mapping[str, object], name: str) -> float:
    """A figure of a simulation's report; nan where the run did not give it."""
    value = run[name]
    return float(value) if isinstance(value, int | float) else math.nan


def measured(values: Iterable[float]) -> list[float]:
    """The values; a nan alone where there are none or one of them is nan, which `max`, `min` and a median would pass
    over or not, as its place among them has it."""
    found = list(values)
    return [math.nan] if not found or any(map(math.isnan, found)) else found


def possible(count: float, least: float) -> float:
    """A count; nan below the least that is possible at all, where something was not counted."""
    return count if count >= least else math.nan


@dataclass(frozen=True)
class Row:
    """One figure. The ratio is value / limit; it is `ok` when at most `goal`."""

    name: str
    value: float
    unit: str
    limit: float
    """The physical limit, the budget, or what a rival took in the same run; same unit."""
    goal: float | None
    """The largest good ratio; None where the figure is shown and not judged."""

    @property
    def ratio(self) -> float:
        """value / limit."""
        return self.value / self.limit if self.limit else math.inf

    @property
    def ok(self) -> bool:
        """Whether the goal was reached; a figure that could not be measured (nan) never is."""
        return self.goal is None or self.ratio <= self.goal

    def json(self) -> str:
        """The row as one JSON object; what could not be measured is null."""
        value, limit = (each if math.isfinite(each) else None for each in (self.value, self.limit))
        ratio = round(self.ratio, 4) if math.isfinite(self.ratio) else None
        return json.dumps(
            {
                "name": self.name,
                "value": value,
                "unit": self.unit,
                "limit": limit,
                "ratio": ratio,
                "goal": self.goal,
                "ok": self.ok,
            }
        )

    def text(self) -> str:
        """The row for people."""
        verdict = "shown" if self.goal is None else "ok" if self.ok else "MISSED"
        goal = "-" if self.goal is None else f"{self.goal:.3g}"
        return (
            f"{self.name:<44} {self.value:>10.4g} {self.unit:<6} limit {self.limit:>8.4g}  "
            f"ratio {self.ratio:>6.3f}  goal {goal:>5}  {verdict}"
        )
