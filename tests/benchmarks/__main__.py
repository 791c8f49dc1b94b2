"""Run the benchmarks named on the command line, or all."""

import sys

from tests.benchmarks import archive, estimators, files, live, offline, stream

BENCHMARKS = {
    "stream": stream.main,
    "estimators": estimators.main,
    "files": files.main,
    "offline": offline.main,
    "live": live.main,
    "archive": archive.main,
}

for name in sys.argv[1:] or BENCHMARKS:
    BENCHMARKS[name]()
