"""Before anything loads NumPy: on a busy machine, threads of BLAS that wait for one another multiply the tests' time."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
