import contextlib

import torch

from jobs.run.torch_threads import torch_threads


def test_threads_are_given_back_after_an_error_too():
    before = torch.get_num_threads()
    with contextlib.suppress(KeyError), torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
        raise KeyError
    assert torch.get_num_threads() == before
