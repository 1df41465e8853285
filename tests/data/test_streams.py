from inspect import signature
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from nerfgrasp.commands.generate import generate
from nerfgrasp.data.streams import SceneSet, StepDataModule, StepStream, check_enough
from nerfgrasp.errors import UserError


def draw(generator: np.random.Generator) -> list[int]:
    return generator.integers(1_000_000, size=4).tolist()


def test_an_item_is_a_function_of_seed_step_and_rank() -> None:
    first = list(islice(StepStream(draw, 3, 0), 6))
    assert first == list(islice(StepStream(draw, 3, 0), 6))
    assert first[4:] == list(islice(StepStream(draw, 3, 4), 2))
    assert len({tuple(item) for item in first}) == 6
    for other in (StepStream(draw, 4, 0), StepStream(draw, 3, 0, rank=1)):
        assert not {tuple(item) for item in islice(other, 6)} & {tuple(item) for item in first}


class Numbers(StepDataModule):
    """The least that a data module needs."""

    def __init__(self, workers: int = 0) -> None:
        super().__init__()
        self.seed, self.workers = 3, workers
        self.train_set = SceneSet(Path("train"), 2, 3, 0)
        self.validation_set = SceneSet(Path("held-out"), 2, 3, 1)

    def draw(self, generator: np.random.Generator) -> list[int]:
        return draw(generator)


def test_a_worker_changes_nothing_in_what_is_drawn() -> None:
    def first(workers: int) -> list[object]:
        loader = Numbers(workers).train_dataloader()
        assert isinstance(loader, DataLoader)
        return list(islice(loader, 3))

    assert first(0) == first(1) == list(islice(StepStream(draw, 3, 0), 3))


def test_validation_alone_needs_no_training_set() -> None:
    module = Numbers()
    assert module.sets() == module.sets("fit") == [module.train_set, module.validation_set]
    assert module.sets("validate") == module.sets("test") == [module.validation_set]


def test_more_than_one_worker_is_refused() -> None:
    Numbers(1).check()
    with pytest.raises(UserError, match="workers is 2: it must be 0 or 1"):
        Numbers(2).check()


def test_too_small_a_set_is_told() -> None:
    check_enough("data.train", "views", 4, 4)
    with pytest.raises(UserError, match="^data.train: 5 views are needed at once, the set has 4$"):
        check_enough("data.train", "views", 5, 4)


def test_a_set_has_images_of_the_size_that_generate_makes() -> None:
    assert SceneSet(Path("train"), 2, 3, 0).size == signature(generate).parameters["size"].default


def test_a_set_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere is no data set"):
        SceneSet(tmp_path / "nowhere", 2, 3, 0).open()
