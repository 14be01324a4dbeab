"""`swarm measure rtt|throughput LINK`: a running link by payload size, as in section 3.6 of the thesis (figure 3.19).

`rtt` sends one ping at a time and waits for its answer of the same length; the throughput it derives is the thesis'
2 s / RTT(s) (equation 3.1), which assumes that only one message is ever under way. `throughput` measures what a link
carries when messages follow each other: pings at once, short answers, from the first to the last of them.
"""

import argparse
import contextlib
import itertools
import json
import queue
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from swarm import clock
from swarm.bus import Bus
from swarm.cli import buses
from swarm.errors import LocalError, PayloadError
from swarm.keys import is_name, key
from swarm.messages import Echo, EchoRequest, read

HELP = "round-trip time or throughput of a link, by payload size"

SIZES = (50, 200, 500, 750, 1000)
"""Bytes; those of the thesis' figure 3.19."""

HEADER = 5
"""Bytes before the payload of a message of the neighbours overlay (docs/frames.md)."""

PATIENCE = 5.0
"""s to wait for an answer."""

_BURST = 64 * 1024
"""Bytes of a burst that measures throughput; at most 256 messages."""


@dataclass(frozen=True)
class Figures:
    """What was measured for one size."""

    size: int
    samples: int
    lost: int
    rtt_min: float | None
    """s; all of them None where no answer came, or where throughput was measured."""
    rtt_median: float | None
    rtt_mean: float | None
    rtt_deviation: float | None
    rtt_p99: float | None
    throughput: float | None
    """bytes/s of payload."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`rtt|throughput LINK [--sizes ...] [--count N] [--plot FILE]`."""
    parser.add_argument("what", choices=("rtt", "throughput"))
    parser.add_argument("link", metavar="LINK", help="r0-r1: from r0 to its neighbour r1; on a robot also just r1")
    parser.add_argument("--sizes", type=_sizes, default=SIZES, metavar="N,N,...", help="payload bytes (50,...,1000)")
    parser.add_argument("--count", type=_count, default=20, metavar="N", help="pings, or bursts, of each size (20)")
    parser.add_argument("--priority", choices=("sync", "bulk"), help="class of the pings (rtt sync, throughput bulk)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw it: .png, .pdf or .svg")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    first, dash, second = args.link.partition("-")
    # A name may have a dash: then only --robot helps.
    if args.robot is None and dash and is_name(first):
        args.robot, peer = first, second
    else:
        peer = args.link
    directories = buses.find(args)
    if len(directories) != 1:
        raise LocalError(f"from which robot? write for example {next(iter(directories))}-{peer}")
    ((robot, directory),) = directories.items()
    if not is_name(peer) or peer == robot:
        raise LocalError(f"link {args.link!r}: expected two robots like r0-r1")
    with _Pinger(robot, peer, directory) as pinger:
        figures = list((_rtt if args.what == "rtt" else _throughput)(pinger, args))
    if args.json:
        print(
            json.dumps({"robot": robot, "peer": peer, "what": args.what, "sizes": [asdict(each) for each in figures]})
        )
    else:
        print("\n".join(_table(robot, peer, args.what, figures)))
    if args.plot is not None:
        _plot(args.plot, f"{robot} - {peer}", args.what, figures)
    return 1 if any(each.samples == 0 for each in figures) else 0


class _Pinger:
    """Asks one robot's mesh to ping a neighbour."""

    def __init__(self, robot: str, peer: str, directory: Path) -> None:
        self._peer = peer
        self._request_key = key(robot, "mesh", "set", "echo")
        self._echoes: queue.SimpleQueue[Echo] = queue.SimpleQueue()
        # Who measures at the same time has other numbers.
        self._sequence = itertools.count(int(clock.wall() * 1e6))
        self._bus = Bus.of(directory)
        if not self._bus.wait_connected(PATIENCE):
            self._bus.close()
            raise LocalError(f"the bus of {robot} is not there ({directory})")
        self._bus.subscribe(key(robot, "mesh", "echo"), self._take)

    def __enter__(self) -> "_Pinger":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    def ping(self, size: int, priority: str, *, count: int = 1, short: bool = False) -> list[Echo]:
        """The answers that came; `LocalError` where the mesh says that it cannot."""
        sequence = next(self._sequence)
        request = EchoRequest(self._peer, sequence, size, count, priority, short)
        self._bus.publish(self._request_key, request)
        answers: list[Echo] = []
        end = clock.now() + PATIENCE
        while len(answers) < count and (left := end - clock.now()) > 0:
            with contextlib.suppress(queue.Empty):
                echo = self._echoes.get(timeout=left)
                if echo.sequence == sequence:
                    if echo.rtt is None:
                        raise LocalError(echo.reason)
                    answers.append(echo)
                    end = clock.now() + PATIENCE
        return answers

    def _take(self, text: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError):
            if isinstance(message := read(text, payload), Echo):
                self._echoes.put(message)


def _rtt(pinger: _Pinger, args: argparse.Namespace) -> Iterator[Figures]:
    """One ping at a time, the sizes in turn, so that what changes meanwhile changes all alike."""
    found: dict[int, list[float]] = {size: [] for size in args.sizes}
    for _ in range(args.count):
        for size in args.sizes:
            found[size] += [echo.rtt for echo in pinger.ping(size, args.priority or "sync") if echo.rtt is not None]
    for size, rtts in found.items():
        yield _figures(size, rtts, args.count - len(rtts))


def _figures(size: int, rtts: Sequence[float], lost: int) -> Figures:
    if not rtts:
        return Figures(size, 0, lost, None, None, None, None, None, None)
    ordered = sorted(rtts)
    median = statistics.median(ordered)
    return Figures(
        size=size,
        samples=len(ordered),
        lost=lost,
        rtt_min=ordered[0],
        rtt_median=median,
        rtt_mean=statistics.fmean(ordered),
        rtt_deviation=statistics.stdev(ordered) if len(ordered) > 1 else 0.0,
        rtt_p99=ordered[len(ordered) * 99 // 100],
        throughput=2.0 * size / median,
    )


def _throughput(pinger: _Pinger, args: argparse.Namespace) -> Iterator[Figures]:
    """Bursts; the time runs from the first answer to the last, so that the latency is not in it."""
    for size in args.sizes:
        count = max(2, min(256, _BURST // size))
        rates, came = [], 0
        for _ in range(max(1, args.count // 10)):
            answers = pinger.ping(size, args.priority or "bulk", count=count, short=True)
            came += len(answers)
            times = sorted(echo.t for echo in answers)
            if len(times) == count and times[-1] > times[0]:
                rates.append((count - 1) * size / (times[-1] - times[0]))
        lost = max(1, args.count // 10) * count - came
        rate = statistics.median(rates) if rates else None
        yield Figures(size, len(rates), lost, None, None, None, None, None, rate)


def _table(robot: str, peer: str, what: str, figures: Sequence[Figures]) -> list[str]:
    if what == "rtt":
        lines = [
            f"{robot} - {peer}: round trip of messages of the neighbours overlay, payload both ways",
            " bytes     n  lost  min ms  median    mean      sd     p99   2s/RTT B/s",
        ]
        for each in figures:
            times = (each.rtt_min, each.rtt_median, each.rtt_mean, each.rtt_deviation, each.rtt_p99)
            cells = "".join(f"{'-' if time is None else f'{time * 1e3:.1f}':>8}" for time in times)
            lines.append(f"{each.size:>6}{each.samples:>6}{each.lost:>6}{cells}{_rate(each):>13}")
        return lines
    lines = [f"{robot} - {peer}: payload of messages that follow each other", " bytes  bursts  lost    payload B/s"]
    return lines + [f"{each.size:>6}{each.samples:>8}{each.lost:>6}{_rate(each):>15}" for each in figures]


def _rate(figures: Figures) -> str:
    return "-" if figures.throughput is None else f"{figures.throughput:.0f}"


def _plot(path: Path, title: str, what: str, figures: Sequence[Figures]) -> None:
    """Figure 3.19: round trip by size, and the rates beside it."""
    try:
        import matplotlib
    except ImportError:
        raise LocalError('--plot needs matplotlib: pip install "balboa-swarm[lab]"') from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    measured = [each for each in figures if each.throughput is not None]
    sizes = [each.size for each in measured]
    figure, axes = pyplot.subplots(
        1, 2 if what == "rtt" else 1, figsize=(10 if what == "rtt" else 5.5, 4), squeeze=False
    )
    rates = axes[0][-1]
    if what == "rtt":
        times = axes[0][0]
        times.errorbar(
            sizes,
            [(each.rtt_mean or 0.0) * 1e3 for each in measured],
            yerr=[(each.rtt_deviation or 0.0) * 1e3 for each in measured],
            fmt="o-",
            capsize=3,
            label="mean, standard deviation",
        )
        times.plot(sizes, [(each.rtt_p99 or 0.0) * 1e3 for each in measured], "x--", label="99th percentile")
        times.set(xlabel="payload / bytes", ylabel="round trip / ms", title=title, ylim=(0, None))
        times.legend()
    kilobytes = [(each.throughput or 0.0) / 1e3 for each in measured]
    rates.plot(sizes, kilobytes, "o-", label="payload, 2 s / RTT" if what == "rtt" else "payload, one after the other")
    if what == "rtt":
        whole = [(size + HEADER) / size * rate for size, rate in zip(sizes, kilobytes, strict=True)]
        rates.plot(sizes, whole, "--", label=f"with the header, 2 (s + {HEADER}) / RTT")
    rates.set(xlabel="payload / bytes", ylabel="kB/s", title=title, ylim=(0, None))
    rates.legend()
    figure.tight_layout()
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise LocalError(f"{path}: {error}") from None
    finally:
        pyplot.close(figure)


def _sizes(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if all(part.isdecimal() and 11 <= int(part) <= 65536 for part in parts):
        return tuple(dict.fromkeys(map(int, parts)))
    raise argparse.ArgumentTypeError(f"{text!r}: expected sizes from 11 to 65536 bytes, like 50,200,1000")


def _count(text: str) -> int:
    if text.isdecimal() and 1 <= int(text) <= 10_000:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: expected a number from 1 to 10000")
