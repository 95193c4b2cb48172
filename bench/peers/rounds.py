"""Processes that run in turn, and what their times say."""

import json
import os
import select
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


class Peer:
    """A runtime in a process of its own, stopped (SIGSTOP) while it is not its turn."""

    def __init__(self, name, precision, command, baseline=None, note=""):
        self.name, self.precision, self.command, self.note = name, precision, command, note
        self.ours = baseline is None
        self.cold, self.turns, self.peak, self.failure, self.process = [], [], None, None, None

    @property
    def label(self):
        return f"{self.name} {self.precision}"

    def start(self, limit):
        """Seconds from the process's start to its first result; None when it cannot run."""
        clock = time.perf_counter()
        self.process = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        answer = self.answer(limit)
        took = time.perf_counter() - clock
        if answer == "ready":
            self.cold.append(took)
            return took
        if answer is not None and answer.startswith("cannot "):
            self.failure = answer[7:]
        else:
            errors = self.process.communicate(timeout=10)[1] if answer is not None else ""
            last = [line for line in errors.strip().splitlines() if line.strip()]
            self.failure = f"failed: {last[-1][:200]}" if last else f"no result within {limit:.0f} s"
        self.end()
        return None

    def answer(self, limit):
        """A line, '' at the end of the output, None after `limit` seconds."""
        ready, _, _ = select.select([self.process.stdout], [], [], limit)
        return self.process.stdout.readline().strip() if ready else None

    def ask(self, line, limit=600):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        answer = self.answer(limit)
        if not answer:
            raise RuntimeError(f"{self.label}: no answer to {line!r}")
        return answer

    def turn(self, runs):
        """Milliseconds of `runs` runs after one that brings the caches back."""
        self.wake()
        times = [int(t) * 1e-6 for t in self.ask(f"run {runs + 1}").split()]
        self.sleep()
        return times[1:]

    def save(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        self.wake()
        self.ask(f"save {folder}")
        self.sleep()

    def wake(self):
        os.kill(self.process.pid, signal.SIGCONT)

    def sleep(self):
        os.kill(self.process.pid, signal.SIGSTOP)

    def memory(self):
        """Peak resident bytes so far."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return 1024 * int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])

    def end(self):
        if self.process is None:
            return
        if self.process.poll() is None:
            self.wake()
            self.process.kill()
        self.process.wait()
        self.process = None

    def median(self):
        return statistics.median(t for turn in self.turns for t in turn)


def python(spec):
    return [sys.executable, str(HERE / "worker.py"), json.dumps(spec)]


def start(peers, cold, limit, say):
    """Starts every peer `cold` times, the others stopped; the last process stays."""
    for peer in peers:
        for _ in range(cold):
            peer.end()
            if peer.start(limit) is None:
                say(f"{peer.label}: {peer.failure}")
                break
        if peer.process is not None:
            peer.sleep()
            say(f"{peer.label}: first result after {min(peer.cold):.2f} s")
    return [p for p in peers if p.process is not None]


def alternate(peers, rounds, turn_ms, say):
    """Every peer once a round, in an order that moves on; about `turn_ms` each, at least one run."""
    runs = {}
    for peer in peers:
        once = peer.turn(1)[0]
        runs[peer] = max(1, min(200, round(turn_ms / once)))
    for r in range(rounds):
        shift = r % len(peers)
        for peer in peers[shift:] + peers[:shift]:
            peer.turns.append(peer.turn(runs[peer]))
        say(f"round {r + 1} of {rounds}")
    for peer in peers:
        peer.peak = peer.memory()


def ratio(peer, base):
    """Median over rounds of the peer's time over the base's in the same round."""
    pairs = zip(peer.turns, base.turns)
    return statistics.median(statistics.median(a) / statistics.median(b) for a, b in pairs)


def spread(peer):
    """Lowest and highest median of a round."""
    medians = [statistics.median(turn) for turn in peer.turns]
    return min(medians), max(medians)


def report(peers, same):
    """Records for JSON; `same` maps a precision to the one of ours it is held against."""
    ours = {p.precision: p for p in peers if p.ours and p.turns}
    fastest = min(ours.values(), key=Peer.median, default=None)
    rows = []
    for peer in peers:
        row = {"runtime": peer.name, "precision": peer.precision, "note": peer.note, "failure": peer.failure}
        if peer.turns:
            low, high = spread(peer)
            own = ours.get(same.get(peer.precision, peer.precision))
            row |= {
                "median_ms": peer.median(),
                "round_low_ms": low,
                "round_high_ms": high,
                "runs": sum(len(turn) for turn in peer.turns),
                "times_ours": None if fastest is None else ratio(peer, fastest),
                "times_ours_same_precision": None if own is None else ratio(peer, own),
                "cold_start_s": statistics.median(peer.cold),
                "peak_rss_bytes": peer.peak,
                "turns_ms": peer.turns,
            }
        rows.append(row)
    return rows


def machine():
    info = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":", 1)[1].strip() for line in info if line.startswith("model name")), "unknown")
    flags = next((line for line in info if line.startswith("flags")), "")
    known = ("avx2", "fma", "avx512f", "avx512_vnni", "avx_vnni", "avx512_bf16", "amx_int8")
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "instructions": [name for name in known if name in flags.split()],
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "load_average": os.getloadavg()[0],
    }


def versions(*names):
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def table(head, rows):
    """Markdown, numbers to the right."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" + "---:|" * (len(head) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def digits(value, form="{:.1f}"):
    return "n/a" if value is None else form.format(value)


def milliseconds(value):
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 1000 else f"{value:.0f}"
