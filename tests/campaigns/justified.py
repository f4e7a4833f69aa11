"""Mutants that no test can kill, each with the reason why it changes nothing that matters."""

JUSTIFIED = {
    "gate": {},
    "watchdog": {},
}
