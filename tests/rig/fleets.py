"""A rig on several hosts, each a `softloop run --host` of its own on this machine, with its own clock where that is permitted."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from softloop.deploy.bench import shipped_benches

LIMIT_S = 300.0  # starting four times, and a report at the end, on a machine that may be busy
HOSTS = ("desk", "devices", "log", "rig")
SHARES = {"plant": "rig", "valves": "devices", "pressures": "devices", "inclinometer": "devices", "controller": "desk",
          "recorder": "log"}  # fmt: skip
ADDRESSES = {"desk": "127.0.0.1", "devices": "127.0.0.2", "log": "127.0.0.3", "rig": "127.0.0.4"}
CLI = (sys.executable, "-m", "softloop.deploy.cli")


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def own_clocks_permitted():
    """A process may be given a monotonic clock of its own here (a time namespace)."""
    return (
        shutil.which("unshare") is not None and subprocess.run(["unshare", "--time", "true"], capture_output=True).returncode == 0
    )


def bench_text(name, *, mode, shared_router=False, base=None, more=""):
    serial, meet = free_port(), free_port()
    tables = "".join(f'[hosts.{host}]\naddress = "{ADDRESSES[host]}"\n' for host in HOSTS)
    keys = {process: f'host = "{host}"\n' for process, host in SHARES.items()}
    keys["plant"] += f'serial = "listen://127.0.0.1:{serial}"\n'
    keys["inclinometer"] += f'port = "socket://127.0.0.1:{serial}"\n'
    shares = "".join(f"[{process}]\n{text}" for process, text in keys.items())
    return (
        f'base = "{base or shipped_benches()["sim"]}"\nname = "{name}"\n'
        f'[zenoh]\nmode = "{mode}"\nendpoint = "tcp/127.0.0.1:{meet}"\n'
        f"[run]\nshared_router = {str(shared_router).lower()}\n{tables}{shares}{more}"
    )


class Host:
    """One host's launcher, by its command line."""

    def __init__(self, fleet, name, inside, report):
        self.name, self.run_dir, self.words = name, fleet.folder / name, fleet.folder / f"{name}.txt"
        command = [*inside, *CLI, "run", str(fleet.bench), "--host", name, "--run-dir", str(self.run_dir)]
        command += [] if report else ["--no-report"]
        with self.words.open("w") as output:
            self.popen = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True, env=fleet.environment
            )

    @property
    def output(self):
        return self.words.read_text()

    @property
    def logs(self):
        return "\n".join(f"--- {self.name}/{p.name}\n{p.read_text()[-1500:]}" for p in sorted(self.run_dir.glob("*.log")))

    def family(self):
        """psutil.Process of the launcher and of all that it started, by what each is: 'launcher', or a process's name."""
        found = {}
        with contextlib.suppress(psutil.NoSuchProcess):
            for process in (psutil.Process(self.popen.pid), *psutil.Process(self.popen.pid).children(recursive=True)):
                with contextlib.suppress(psutil.NoSuchProcess):
                    words = process.cmdline()
                    if "node" in words:
                        found[words[words.index("node") + 1]] = process
                    elif "run" in words and words[0] != "unshare":
                        found["launcher"] = process
        return found


class Fleet:
    """All hosts of a bench, and a router of its own where the bench wants one."""

    def __init__(self, text):
        self.folder = Path(tempfile.mkdtemp(prefix="sl-fleet-"))
        self.bench = self.folder / "bench.toml"
        self.bench.write_text(text)
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(self.folder)}
        self.hosts, self.seen, self.routers = {}, {}, []
        self.began = time.monotonic()

    def start(self, name, ahead_s=0, report=False, inside=()):
        """Start a host's launcher, with a clock that is ahead or `inside` namespaces: the command that runs another in them."""
        own_clock = ["unshare", "--time", f"--monotonic={ahead_s}", "--fork", "--kill-child"] if ahead_s else []
        self.hosts[name] = Host(self, name, [*inside, *own_clock], report)
        return self.hosts[name]

    def start_router(self, inside=()):
        """Start `softloop router`; returns when it says that it is there."""
        words = self.folder / f"router-{len(self.routers)}.txt"
        with words.open("w") as output:
            command = [*inside, *CLI, "router", str(self.bench), "--with", "softloop"]
            self.routers.append(subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=self.environment))
        while "meeting point of bench" not in words.read_text():
            assert self.routers[-1].poll() is None, words.read_text()
            time.sleep(0.002)
        return self.routers[-1]

    def family(self):
        """(host, what it is) -> psutil.Process, of all that runs now."""
        now = {(name, what): process for name, host in self.hosts.items() for what, process in host.family().items()}
        self.seen.update({process.pid: process for process in now.values()})
        return now

    def wait_for(self, condition, what):
        while not condition():
            self.family()
            assert time.monotonic() - self.began < LIMIT_S, f"{what}: not within {LIMIT_S} s\n{self.report()}"
            time.sleep(0.05)

    def wait_for_word(self, host, word):
        self.wait_for(lambda: word in self.hosts[host].output or self.hosts[host].popen.poll() is not None, f"'{word}' of {host}")
        assert word in self.hosts[host].output, self.report()

    def finish(self):
        """Wait for the end of all; returns host -> exit code."""
        self.wait_for(lambda: all(host.popen.poll() is not None for host in self.hosts.values()), "the end of all")
        return {name: host.popen.returncode for name, host in self.hosts.items()}

    def report(self):
        return "\n".join(f"=== {name}\n{host.output[-3000:]}\n{host.logs}" for name, host in self.hosts.items())

    def left_over(self, patience_s=15.0):
        end = time.monotonic() + patience_s
        alive = list(self.seen.values())
        while alive and time.monotonic() < end:
            alive = [p for p in alive if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
            time.sleep(0.1)
        return [" ".join(p.cmdline()) for p in alive]

    def close(self):
        self.family()
        for process in self.seen.values():
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGCONT)
                process.kill()
        for popen in [*self.routers, *(host.popen for host in self.hosts.values())]:
            if popen.poll() is None:
                popen.kill()
            popen.wait(10)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextlib.contextmanager
def fleet(text):
    """A fleet that is ended, whatever happens, when the block is left."""
    made = Fleet(text)
    try:
        yield made
    finally:
        made.close()
