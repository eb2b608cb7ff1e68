"""How many of torch's threads work on what."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch as th


@contextlib.contextmanager
def torch_threads(n_threads: int) -> Iterator[None]:
    """
    Run with another number of torch threads; two on busy cores are ten times slower than one, as they wait by spinning.

    :param n_threads: within the context
    """
    before = th.get_num_threads()
    th.set_num_threads(n_threads)
    try:
        yield
    finally:
        th.set_num_threads(before)


def run_side_by_side(functions: Sequence[Callable[[], None]], device: th.device) -> None:
    """
    Call functions that have nothing to do with each other, at the same time if torch has threads for all of them.

    The networks of a task are so small that a second thread within one operation does little; in another function it counts
    in full. On a GPU, whose operations queue up anyway, and with fewer threads than functions, one is called after another.

    :param functions: the first is called in this thread
    :param device: that they compute on
    """
    share = th.get_num_threads() // max(1, len(functions))
    if len(functions) < 2 or share == 0 or device.type != "cpu":
        for function in functions:
            function()
        return
    here, *others = functions
    # Leaving the pool waits for all of them, whatever happens here.
    with torch_threads(share), ThreadPoolExecutor(len(others)) as pool:
        jobs = [pool.submit(function) for function in others]
        here()
    for job in jobs:
        job.result()
