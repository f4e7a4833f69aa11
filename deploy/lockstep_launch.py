"""A run at lockstep pace, as its launcher sees it."""

from __future__ import annotations

from softloop.deploy.bench import Bench
from softloop.deploy.gate_requests import Requests
from softloop.deploy.launcher import POLL_S, Launch, Outcome
from softloop.deploy.node import processes_of
from softloop.deploy.rig_state import GATE_FAULT
from softloop.wire.channels import HELLO
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_NEGATIVE, EXIT_OK
from softloop.wire.lockstep import Lockstep
from softloop.wire.schedule import LAUNCHER_ORIGIN, Schedule, make_schedule

AFTER_S = 0.1  # from the end of the trajectory to disarming


class LockstepLaunch(Launch):
    """A run at lockstep pace: planned beforehand, tick by tick, and over when the plant has taken the last one."""

    def _keep_listeners(self) -> None:
        pass

    def _until_over(self) -> Outcome:
        self._start()
        return self._wait_alive() or self._conduct() or self._watch_ticks()

    def _conduct(self) -> Outcome | None:
        """Hand the gate its requests beforehand, and give the word to begin."""
        schedule = schedule_of(self.bench, self.trajectory_s)
        pace = Lockstep(self.bench.pace, self.wire, self.stop, {p.name for p in processes_of(self.bench)})
        pace.meet(pace.others, None)
        requests = Requests(self.wire, LAUNCHER_ORIGIN)
        if self.bench.run.arm:
            requests.send("arm", schedule.arm_ns)
            requests.send("disarm", schedule.disarm_ns)
            pace.board.wait(
                lambda: pace.board.present["valves"].requests >= 2, lambda: "'valves', which has two requests to take"
            )
        pace.board.wait(lambda: pace.board.tick is not None, lambda: "'plant'", lambda: pace.say(HELLO, ticks=schedule.ticks))
        return self._trouble()

    def _watch_ticks(self) -> Outcome:
        while True:
            self._refresh("running")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if all(child.exit_code() == EXIT_OK for name, child in self.children.all.items() if name != "recorder"):
                return self._over()
            self.stop.wait(POLL_S)

    def _over(self) -> Outcome:
        self._refresh("running")
        if self.state.gate == GATE_FAULT:
            return Outcome(EXIT_NEGATIVE, f"the gate went to FAULT: {self.state.reason}")
        if self.bench.run.arm and not self.state.was_armed:
            return Outcome(EXIT_NEGATIVE, f"the gate was not armed: {self._words_of_gate()}")
        return Outcome(EXIT_OK, "the run is over, tick by tick")

    def _trouble(self) -> Outcome | None:
        if self.stop:
            return Outcome(EXIT_INTERRUPTED, f"interrupted ({self.stop.reason})")
        lost = next((c for c in self.children.all.values() if c.exit_code() not in (None, EXIT_OK)), None)
        return self._of_fleet() if lost is None else self._lost(lost)

    def _vented(self, outcome: Outcome) -> Outcome:
        return outcome  # venting is part of the plan


def schedule_of(bench: Bench, trajectory_s: float) -> Schedule:
    """The plan of a run: settle, arm, follow the trajectory (or `[run] duration_s`), disarm, vent."""
    approach_s = bench.controller.approach_s if bench.controller is not None else 0.0
    armed_s = bench.run.duration_s or approach_s + trajectory_s + AFTER_S
    return make_schedule(bench.run.settle_s, armed_s, bench.run.vent_timeout_s)
