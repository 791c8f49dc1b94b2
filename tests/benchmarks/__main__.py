"""Run the benchmarks named on the command line, or all."""

import sys

from tests.benchmarks import estimators, files, stream

BENCHMARKS = {"stream": stream.main, "estimators": estimators.main, "files": files.main}

for name in sys.argv[1:] or BENCHMARKS:
    BENCHMARKS[name]()
