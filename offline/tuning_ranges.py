"""Which gains of a law are tuned, and where the search for them starts. Plain numbers: the command line reads them too."""

from __future__ import annotations

Ranges = dict[str, tuple[float, float]]

_DRIVE: Ranges = {"actuation.flow_hold_kpa_s": (2.0, 60.0), "actuation_delay_ms": (1.0, 10.0)}
_PID: Ranges = {
    "pid.kp": (0.1, 10.0),
    "pid.ki": (0.5, 50.0),
    "pid.kd": (0.01, 1.0),
    "pid.kv": (0.05, 1.0),
    "pid.ka": (0.002, 0.1),
    "pid.pressure_gain": (5.0, 100.0),
}
_BACKSTEPPING: Ranges = {"k_s": (2.0, 40.0), "k1": (3.0, 80.0), "k2": (10.0, 150.0), "rho": (1.0, 100.0)}
_ROBUST: Ranges = {"epsilon1": (5e3, 5e5), "epsilon2": (1e4, 1e6)}
_OBSERVER: Ranges = {
    "observer.rate_1_s": (20.0, 200.0),
    "observer.angle_1_s": (2.0, 30.0),
    "observer.pressure_1_s": (15.0, 150.0),
    "observer.line_ms": (1.0, 8.0),
    "observer.play_ma": (3.0, 16.0),
}


def _of(law: str, ranges: Ranges) -> Ranges:
    return {f"{law}.{name}": span for name, span in ranges.items()}


RANGES: dict[str, Ranges] = {
    "pid": _PID | _DRIVE,
    "pid_eso": _PID | _OBSERVER | _DRIVE,
    "smc": _of("smc", _BACKSTEPPING | _ROBUST) | _DRIVE,
    "arc": _of("arc", _BACKSTEPPING | _ROBUST | {"gamma": (1e-6, 1e-3), "gamma_valve": (1e-7, 1e-4)}) | _DRIVE,
    "arc_eso": _of("arc_eso", _BACKSTEPPING) | _OBSERVER | _DRIVE,
    "pressure": {"pressure.k2": (5.0, 100.0), "pressure.delta2": (2.0, 200.0), "pressure.epsilon2": (1e2, 1e5)} | _DRIVE,
    "pressure_eso": {
        "pressure.k2": (5.0, 100.0),
        "observer.pressure_1_s": (15.0, 150.0),
        "observer.play_ma": (3.0, 16.0),
        "observer.play_still_ma": (0.05, 3.0),
        "observer.teach_kpa": (10.0, 90.0),
        "observer.growth_1_deg": (5e-4, 5e-3),
    }
    | _DRIVE,
}
