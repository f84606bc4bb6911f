from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tests work on tiny tensors: on a busy machine torch's threads would only wait for each other, for minutes.

    A test that is about threads sets their number itself; it is put back here.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
