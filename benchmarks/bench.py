"""Steps per second, side by side: `equipoise bench` with the thread pools of BLAS switched off.

They are read when NumPy is loaded, so they are set before anything is. All arguments are passed on;
`python benchmarks/bench.py --help` lists them.
"""

import os
import runpy
import sys

POOLS = (
    "MKL_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)

if __name__ == "__main__":
    os.environ.update(dict.fromkeys(POOLS, "1"))
    sys.argv[1:1] = ["bench"]
    runpy.run_module("equipoise", run_name="__main__")
