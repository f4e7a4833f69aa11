"""`[recorder]` of the bench file."""

from __future__ import annotations

from pydantic import Field

from softloop.wire.benchfile import Table


class RecorderConfig(Table):
    """`[recorder]`: what the log keeps, and how much the recorder may hold back before it has to drop."""

    file: str = Field("run.mcap", pattern=r"^[A-Za-z0-9_.-]+\.mcap$", description="name of the log in the run's directory")
    flush_s: float = Field(0.5, gt=0, le=60, description="how much of a run a killed recorder may cost")
    poll_s: float = Field(0.02, gt=0, le=1, description="how often arrived messages are taken")
    chunk_kib: int = Field(64, ge=4, le=4096, description="uncompressed size at which a chunk is closed")
    backlog_messages: int = Field(100_000, ge=1, le=10_000_000, description="messages waiting; beyond it the oldest go")
    unwritten_mib: int = Field(64, ge=1, le=4096, description="bytes the disk did not take yet; beyond it new messages go")
    drain_s: float = Field(3.0, ge=0, le=60, description="time allowed at the end for what is still waiting")
