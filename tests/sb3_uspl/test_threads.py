"""Functions side by side: all run, at once where there are threads for them, and none fails unnoticed."""

import threading

import pytest
import torch as th

from sb3_uspl._threads import run_side_by_side, torch_threads

CPU = th.device("cpu")


def test_each_gets_its_share_of_the_threads():
    shares = []
    both = threading.Barrier(2, timeout=20)  # neither gets past it alone

    def work():
        both.wait()
        shares.append(th.get_num_threads())

    with torch_threads(4):
        run_side_by_side([work, work], CPU)
        assert shares == [2, 2] and th.get_num_threads() == 4


@pytest.mark.parametrize("n_threads, device", [(1, "cpu"), (4, "cuda")])
def test_one_after_another_without_threads_for_all_and_on_a_gpu(n_threads, device):
    order = []

    def work(name):
        order.append((name, threading.current_thread()))

    with torch_threads(n_threads):
        run_side_by_side([lambda: work("first"), lambda: work("second")], th.device(device))
    here = threading.current_thread()
    assert order == [("first", here), ("second", here)]


@pytest.mark.parametrize("n_threads", [1, 2])
@pytest.mark.parametrize("failing", [0, 1])
def test_an_error_in_either_is_raised(n_threads, failing):
    def fail():
        raise RuntimeError("a learner's own")

    functions = [lambda: None, lambda: None]
    functions[failing] = fail
    with torch_threads(n_threads), pytest.raises(RuntimeError, match="a learner's own"):
        run_side_by_side(functions, CPU)


def test_nothing_to_do_is_no_error():
    run_side_by_side([], CPU)
