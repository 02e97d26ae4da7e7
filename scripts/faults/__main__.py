"""Runs the commands through faults and counts what happens.

python -m scripts.faults                                  # all campaigns
python -m scripts.faults --only toml --cases toml=1000000
python -m scripts.faults --page                           # and write docs/faults.md

Every finished case is kept in one file: the same command goes on where the last one stopped,
however it was stopped, and more --cases go on from there. Exits with 1 if a promise was broken in
any case of the file. It needs Linux and a C compiler (`cc`, or the one in CC).
"""

import argparse
import datetime
import signal
import sys
from pathlib import Path

from scripts.faults import cases, page
from scripts.faults.harness import Harness
from scripts.faults.store import Store
from scripts.shared import output, provenance


def main() -> int:
    """Runs what is left and returns the exit status."""
    options = _parse()
    store = Store(options.store)
    if options.again:
        bad = [p.campaign for p in store.parts if p.bad]
        print(f"{store.forget(lambda part: bool(part.bad))} parts again: {sorted(set(bad))}")
    if options.forget:
        print(f"{store.forget(lambda part: part.campaign in options.forget)} parts forgotten")
    chosen = [c for c in cases.CAMPAIGNS.values() if not options.only or c.name in options.only]
    counts = {c.name: options.cases.get(c.name, c.count) for c in chosen}
    left = {c.name: sum(map(len, store.left(c.name, counts[c.name], c.size))) for c in chosen}
    if options.list:
        for c in cases.CAMPAIGNS.values():
            print(f"{c.name:18} {c.count:8}  {page.rows()[c.name][1]}")
        return 0
    if any(left.values()):
        store.start(provenance.measurement(options.commit))
        print(f"{sum(left.values())} cases of {sum(n > 0 for n in left.values())} campaigns")
        harness = Harness(store, options.work, _tell)
        signal.signal(signal.SIGINT, lambda *_: (_tell("stopping"), harness.stop.set()))
        harness.run(chosen, counts, options.workers)
    found = {name: store.summary(name) for name in cases.CAMPAIGNS}
    if options.page:
        data = {"starts": store.starts, "campaigns": found}
        output.write_json(options.json, data)
        page.write(data)
    return _conclude(found)


def _conclude(found: dict) -> int:
    """Prints what was found and returns the exit status."""
    broken = 0
    for name, campaign in cases.CAMPAIGNS.items():
        counts = found[name]["counts"]
        if not counts:
            continue
        bad = sum(n for word, n in counts.items() if word not in campaign.good)
        words = ", ".join(f"{n} {word}" for word, n in counts.items())
        seconds = found[name]["seconds"]
        print(f"{'BROKEN' if bad else 'kept':7} {name:14} {words} ({seconds:.0f} s)")
        broken += bad
    total = sum(found[name]["cases"] for name in found)
    print(f"{total} cases, {broken} broke a promise")
    return int(broken > 0)


def _tell(text: str) -> None:
    now = datetime.datetime.now().astimezone().strftime("%H:%M:%S")
    print(f"{now} {text}", flush=True)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m scripts.faults",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*cases.CAMPAIGNS])
    parser.add_argument("--cases", nargs="+", default={}, metavar="NAME=N", action=_Counts)
    parser.add_argument("--store", type=Path, default=Path("runs/faults/store.jsonl"))
    parser.add_argument("--work", type=Path, default=Path("runs/faults/work"), help="caches, runs")
    parser.add_argument("--workers", type=int, default=1, help="processes that run cases")
    parser.add_argument("--again", action="store_true", help="once more what broke a promise")
    parser.add_argument(
        "--forget", nargs="+", metavar="NAME", help="begin these anew", choices=[*cases.CAMPAIGNS]
    )
    parser.add_argument("--list", action="store_true", help="print the campaigns and stop")
    parser.add_argument("--page", action="store_true", help="write docs/faults.md and its data")
    parser.add_argument("--json", type=Path, default=page.PAGE.parent / "data" / "faults.json")
    provenance.add_commit(parser)
    return parser.parse_args()


class _Counts(argparse.Action):
    """NAME=N ... as a dictionary."""

    def __call__(self, parser, namespace, values, option=None):
        counts = {}
        for text in values:
            name, _, number = text.partition("=")
            if name not in cases.CAMPAIGNS or not number.isdecimal():
                parser.error(f"--cases {text}: must be NAME=N; names: {', '.join(cases.CAMPAIGNS)}")
            counts[name] = int(number)
        setattr(namespace, self.dest, counts)


if __name__ == "__main__":
    sys.exit(main())
