"""Torch and linear algebra on one thread, and back."""

from collections.abc import Iterator

import numpy as np
import pytest
import threadpoolctl
import torch

from dropo_torch.support.threads import single_thread


def linear_algebra() -> set[int]:
    """Threads of the libraries that NumPy and SciPy compute with."""
    return {library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def several_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    with threadpoolctl.threadpool_limits(3, user_api="blas"):
        yield
    torch.set_num_threads(before)


def test_everything_within_computes_on_one_thread() -> None:
    outside = linear_algebra()
    with single_thread():
        assert torch.get_num_threads() == 1
        assert linear_algebra() == {1}
    assert torch.get_num_threads() == 3
    assert linear_algebra() == outside


def test_the_last_to_leave_brings_back_what_the_first_found() -> None:
    outside, first, second = linear_algebra(), single_thread(), single_thread()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert (torch.get_num_threads(), linear_algebra()) == (1, {1})
    second.__exit__(None, None, None)
    assert (torch.get_num_threads(), linear_algebra()) == (3, outside)


def test_an_error_brings_them_back_and_a_function_may_be_decorated() -> None:
    @single_thread()
    def fails() -> None:
        assert linear_algebra() == {1}
        np.linalg.inv(np.zeros((2, 2)))

    outside = linear_algebra()
    for _ in range(2):
        with pytest.raises(np.linalg.LinAlgError):
            fails()
        assert (torch.get_num_threads(), linear_algebra()) == (3, outside)
