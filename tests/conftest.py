"""What every test may ask for."""

import os

# Before torch is imported here and in every process that a test starts: two threads are plenty for small tensors.
os.environ.setdefault("OMP_NUM_THREADS", "2")
# Nothing is fetched in a test, and nothing may quietly be.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# No window and no warning about one.
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
import torch

from nerfgrasp.scenes.scene import Workspace


@pytest.fixture(autouse=True, scope="session")
def _few_threads() -> None:
    torch.set_num_threads(2)


@pytest.fixture
def workspace() -> Workspace:
    """A box that is no cube and not centred, so that mixed-up axes and corners show."""
    return Workspace(torch.tensor([-0.25, -0.2, 0.0]), torch.tensor([0.25, 0.3, 0.2]))
