"""cuthbert: its filter and smoother that are parallel in time, by associative scans."""

from functools import partial

from smoothing_cuthbert import prepare
from timed import serve

if __name__ == "__main__":
    serve(partial(prepare, parallel=True, runs=200), ("cuthbert", "jax", "numpy"))
