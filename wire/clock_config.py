"""`[clock]`: how the clocks of a bench's hosts are held together."""

from __future__ import annotations

from pydantic import Field

from softloop.wire.benchfile import Table


class ClockConfig(Table):
    """`[clock]`: with several hosts, how far each host's clock may be unsure against that of the controller's host."""

    uncertainty_max_ms: float = Field(2.0, gt=0, le=1000, description="a clock that is less sure ends the run; none arms before")
    drift_max_ppm: float = Field(100.0, gt=0, le=5000, description="two clocks run apart no faster than this; faster is an event")
    step_min_ms: float = Field(1.0, gt=0, le=10_000, description="a clock that jumps by more is an event")
    period_ms: float = Field(100.0, ge=10, le=10_000, description="from one exchange of times to the next")
