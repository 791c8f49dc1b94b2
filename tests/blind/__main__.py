"""`python -m tests.blind`: seal, run, open, and write tests/blind/REPORT.md.

A run is kept in a folder, so that one that was interrupted goes on with `--resume FOLDER`; the report says how many
envelopes it is of.
"""

import argparse
import secrets
import signal
import sys
from dataclasses import fields
from math import inf
from pathlib import Path
from time import monotonic

from aemd.diagnose import COVERED
from tests.blind.envelope import Mix
from tests.blind.harness import Sealed, open_folder, run_all, seal
from tests.blind.report import write_report
from tests.blind.score import Pair

HELP = {
    "clean": "with nothing hidden, a third of them provocative",
    "rungs": "of each mechanism, at 1.25 times the clairvoyant's limit",
    "singles": "one mechanism each, at other multiples of it",
    "doubles": "two at once, at twice the limit",
    "outside": "one that the catalogue does not have, at twice the limit",
    "below": "one of 1.5 nats, which nobody could see",
    "gains": "one of 60 to 120 nats, to measure what knowing it is worth",
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.blind", description=__doc__)
    for field in fields(Mix):
        parser.add_argument(f"--{field.name}", type=int, default=field.default, help=HELP[field.name])
    parser.add_argument("--salt", help="without it a secret one, told in the report")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="of the key and the answers; without it one named by the hour")
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help="go on with a key that was sealed before")
    parser.add_argument("--seal-only", action="store_true", help="write the key, print its hash, and run nothing")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "REPORT.md")
    parser.add_argument("--minutes", type=float, default=inf, help="of running; what is left then may be resumed")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that what is ended is reported, too
    if options.resume:
        sealed = open_folder(options.resume)
    else:
        mix = Mix(**{field.name: getattr(options, field.name) for field in fields(Mix)})
        salt = options.salt or secrets.token_hex(16)
        begun = monotonic()
        sealed = seal(salt, mix, options.jobs, options.folder or Path("blind-runs") / secrets.token_hex(4))
        say(f"{len(sealed.envelopes)} envelopes sealed in {monotonic() - begun:.0f} s")
    say(f"key SHA-256 {sealed.key_hash}, in {sealed.folder}; {len(sealed.answers)} have answers already")
    if options.seal_only:
        return
    try:
        run(sealed, options.jobs, 60 * options.minutes)
    except KeyboardInterrupt:
        say(f"interrupted; go on with --resume {sealed.folder}")
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sealed = open_folder(sealed.folder)
    pairs = [
        Pair(envelope, sealed.answers[envelope.number])
        for envelope in sealed.envelopes
        if envelope.number in sealed.answers
    ]
    report = write_report(
        pairs, sealed=len(sealed.envelopes), salt=sealed.salt, key_hash=sealed.key_hash, covered=COVERED
    )
    options.out.write_text(report)
    print(report)


def run(sealed: Sealed, jobs: int, seconds: float) -> None:
    """Ask, and tell how far it is and when it will be done."""
    left, begun = len(sealed.envelopes) - len(sealed.answers), monotonic()
    for count, _ in enumerate(run_all(sealed, jobs, seconds), start=1):
        ends_s = (monotonic() - begun) / count * (left - count)
        print(f"\r{count}/{left}, {ends_s / 60:.1f} minutes left ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
