"""What the surface stage costs, against the number of instances: nothing is asserted, timings are the machine's.

    PYTHONPATH=. python tests/surface_cost.py [megapixels] [instances ...]      default: 12 2000 6000 20000
"""

import resource
import subprocess
import sys
import time

import numpy as np
from synthetic_instances import instances_of

from sftex_stages import surface


def measure(megapixels: float, count: int) -> tuple[float, float, float]:
    """CPU seconds, GB at most, and median error in degrees of a wavy sheet with `count` instances of 40 textons."""
    width, height = int(np.sqrt(megapixels * 1e6 * 4 / 3)), int(np.sqrt(megapixels * 1e6 * 3 / 4))
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, [width - 1, height - 1], (count, 2))

    def slope(at):
        u = 2 * np.pi * at / width
        return np.stack((0.8 * np.cos(3 * u[..., 0]) + 0.1, -0.7 * np.sin(3 * u[..., 1])), -1)

    n = np.stack((-slope(xy)[:, 0], -slope(xy)[:, 1], np.ones(count)), 1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    light = 0.5 + 0.4 * n[:, 2] - 0.3 * n[:, 1] + 0.1 * n[:, 0]
    parts = instances_of((xy, slope(xy)), noise=0.02, textons=40, light=light)
    image = {"mask": np.ones((height, width), bool)}
    start = time.process_time()
    out = surface.run({"image": image, "frontal": parts}, surface.Params())
    spent = time.process_time() - start
    rows, columns = np.mgrid[10 : height : height // 60, 10 : width : width // 80]
    g = slope(np.stack((columns, rows), -1).astype(float))
    truth = np.concatenate((-g, np.ones_like(g[..., :1])), -1)
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    found, valid = out["normals"][rows, columns], out["valid"][rows, columns]
    off = np.degrees(np.arccos(np.clip((found * truth).sum(-1)[valid], -1, 1)))
    return spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, float(np.median(off))


def main(arguments: list[str]) -> None:
    megapixels = float(arguments[0]) if arguments else 12.0
    counts = [int(a) for a in arguments[1:]] or [2000, 6000, 20000]
    if len(counts) == 1:
        print("{:.1f} s CPU, {:.2f} GB, median error {:.2f}°".format(*measure(megapixels, counts[0])), flush=True)
        return
    for count in counts:  # a process each: memory at most is of one
        print(f"{megapixels:g} megapixels, {count} instances: ", end="", flush=True)
        subprocess.run([sys.executable, __file__, str(megapixels), str(count)], check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
