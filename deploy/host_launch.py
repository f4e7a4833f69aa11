"""A run's share on a host that does not lead."""

from __future__ import annotations

import time

from softloop.deploy.fleet import TROUBLE, Fleet
from softloop.deploy.launcher import POLL_S, Launch, Outcome
from softloop.deploy.launcher_events import SOURCES
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_OK


class FollowLaunch(Launch):
    """Starts its share once it knows the time, and stops it when the host that leads says so, or is lost.

    At lockstep pace its processes end by themselves, with the last tick.
    """

    fleet: Fleet

    def _until_over(self) -> Outcome:
        outcome = self._wait_for_clock()
        if outcome is None:
            self._start()
            outcome = self._wait_alive()
        return outcome or self._follow()

    def _wait_for_clock(self) -> Outcome | None:
        """Nothing here stamps anything before it can be in the rig's time."""
        end_s = time.monotonic() + self.bench.run.hosts_wait_s
        if not self.fleet.clock_known:
            self.view.say(f"waiting for host '{self.fleet.leader}', which keeps the clock")
        while not self.fleet.clock_known:
            self._refresh("waiting")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if time.monotonic() >= end_s:
                limit_s = self.bench.run.hosts_wait_s
                return Outcome(EXIT_LOST, f"host '{self.fleet.leader}', which keeps the clock, is not there after {limit_s:g} s")
            self.stop.wait(POLL_S)
        return None

    def _keep_listeners(self) -> None:
        if self.bench.pace.mode == "wall":
            super()._keep_listeners()

    def _follow(self) -> Outcome:
        while True:
            self._refresh("running")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if self._is_done():
                return Outcome(EXIT_OK, "the run is over, tick by tick")
            self.stop.wait(POLL_S)

    def _is_done(self) -> bool:
        lockstep = self.bench.pace.mode == "lockstep"
        return lockstep and all(child.exit_code() == EXIT_OK for child in self.children.all.values())

    def _trouble(self) -> Outcome | None:
        if self.fleet.leader_ended:
            return self._of_fleet()
        if self.stop:
            return Outcome(EXIT_INTERRUPTED, f"interrupted ({self.stop.reason})")
        good = (None, EXIT_OK) if self.bench.pace.mode == "lockstep" else (None,)
        kept = self.keeper.names
        ended = next((c for c in self.children.all.values() if c.name not in kept and c.exit_code() not in good), None)
        return self._lost(ended) if ended is not None else self._without_router() or self._of_fleet()

    def _vented(self, outcome: Outcome) -> Outcome:
        """Leave venting to the host that leads, which waits for it; where that is lost, do it from here."""
        if self.fleet.leader_there and not self.fleet.leader_ended and not self._is_done():
            self.fleet.say(TROUBLE, outcome.code, SOURCES.get(self.lost_name, 0))
            end_s = time.monotonic() + self.bench.run.vent_timeout_s + self.bench.run.host_silence_s
            while self.fleet.leader_there and not self.fleet.leader_ended and time.monotonic() < end_s:
                self._refresh("stopping")
                time.sleep(POLL_S)
        if self.fleet.leader_ended or self.bench.pace.mode == "lockstep":
            return outcome
        return super()._vented(outcome)
