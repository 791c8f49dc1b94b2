"""`python -m tests.blind`: seal, run, open, and write tests/blind/REPORT.md."""

import argparse
import secrets
import sys
from math import inf
from pathlib import Path
from time import monotonic

from aemd.diagnose import COVERED
from tests.blind.harness import run_all, seal
from tests.blind.report import write_report
from tests.blind.score import Pair


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.blind", description=__doc__)
    parser.add_argument("--runs", type=int, default=300, help="of the envelope mix")
    parser.add_argument("--rungs", type=int, default=8, help="of each mechanism, at 1.25 times the clairvoyant's limit")
    parser.add_argument("--seed", help="the salt; without it a secret one, told in the report")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "REPORT.md")
    parser.add_argument("--minutes", type=float, default=inf, help="of running; what is left then is left unopened")
    options = parser.parse_args()
    salt = options.seed or secrets.token_hex(16)
    envelopes, key_hash = seal(salt, options.runs, options.rungs, options.jobs)
    print(f"sealed {len(envelopes)} envelopes, key SHA-256 {key_hash}", file=sys.stderr, flush=True)
    pairs, begun = [], monotonic()
    for envelope, answer in zip(envelopes, run_all(envelopes, options.jobs), strict=False):
        pairs.append(Pair(envelope, answer))
        print(f"\r{len(pairs)}/{len(envelopes)}", end="", file=sys.stderr)
        if monotonic() - begun > 60 * options.minutes:  # their order was shuffled, so these are as good as any
            break
    print(file=sys.stderr)
    report = write_report(pairs, salt=salt, key_hash=key_hash, covered=COVERED)
    options.out.write_text(report)
    print(report)


if __name__ == "__main__":
    main()
