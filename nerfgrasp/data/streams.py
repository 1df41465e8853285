"""Training batches as a function of (seed, step), so that a resumed run draws what an unbroken one would."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from lightning import LightningDataModule
from torch.utils.data import DataLoader, IterableDataset

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.images import IMAGE_SIZE

if TYPE_CHECKING:
    from nerfgrasp.data.packed import PackedScenes

Batch = TypeVar("Batch")


@dataclass(frozen=True)
class SceneSet:
    """A packed set of simulated scenes: where it is, and how to make it if it is not there."""

    folder: Path
    """The set's folder."""
    scenes: int
    """How many scenes it has."""
    views: int
    """Views a scene."""
    seed: int
    """The seed from which every scene is drawn; sets of different seeds share no scene."""
    task: str = "simple"
    """The task that draws the scenes."""
    size: int = IMAGE_SIZE
    """The images' side in pixels."""
    demonstrations: bool = False
    """Whether each scene has a demonstrated grasp."""
    depth: bool = False
    """Whether the images' depth is kept, for the methods that need it."""

    def open(self) -> "PackedScenes":
        """Opens the set.

        Raises:
            UserError: it is missing, incomplete or damaged.
        """
        from nerfgrasp.data.packed import PackedScenes

        return PackedScenes(self.folder)


class StepStream(IterableDataset[Batch]):
    """An endless stream whose item number `step` is `draw(generator)` with a generator of (seed, step, rank)."""

    def __init__(self, draw: Callable[[np.random.Generator], Batch], seed: int, start: int, rank: int = 0) -> None:
        self.draw, self.seed, self.start, self.rank = draw, seed, start, rank

    def __iter__(self) -> Iterator[Batch]:
        step = self.start
        while True:
            yield self.draw(np.random.default_rng((self.seed, step, self.rank)))
            step += 1


class StepDataModule(LightningDataModule):
    """A data module whose training batches are drawn anew for every step, starting at the trainer's.

    Subclasses give `draw(generator)` and a validation loader, and extend `check`.
    """

    train_set: SceneSet | Path
    validation_set: SceneSet | Path
    seed: int
    workers: int
    """Processes that draw batches beside the training (0 or 1); they change nothing in what is drawn."""

    def sets(self, stage: str = "fit") -> list[SceneSet]:
        """Returns the sets that a stage (`fit`, `validate`, `test`) reads, so that missing ones can be made."""
        read = [self.train_set, self.validation_set] if stage == "fit" else [self.validation_set]
        return [scenes for scenes in read if isinstance(scenes, SceneSet)]

    def check(self, stage: str = "fit") -> None:
        """Compares what a stage draws with what its sets hold, before any is made.

        Raises:
            UserError: a set has too few scenes or views, or there are too many workers.
        """
        if self.workers not in (0, 1):
            raise UserError(f"data.init_args.workers is {self.workers}: it must be 0 or 1")

    def draw(self, generator: np.random.Generator) -> object:
        """Returns one training batch."""
        raise NotImplementedError

    def train_dataloader(self) -> DataLoader:
        """Returns the stream from the trainer's global step on."""
        trainer = self.trainer
        start, rank = (
            (trainer.global_step * trainer.accumulate_grad_batches, trainer.global_rank) if trainer else (0, 0)
        )
        stream = StepStream(self.draw, self.seed, start, rank)
        # Forked, so that the open sets need not be pickled.
        context = "fork" if self.workers else None
        return DataLoader(stream, batch_size=None, num_workers=self.workers, multiprocessing_context=context)


def check_enough(where: str, what: str, needed: int, there: int) -> None:
    """Refuses a set that is too small.

    Raises:
        UserError: there are fewer of `what` than needed at once; the message begins with `where`.
    """
    if there < needed:
        raise UserError(f"{where}: {needed} {what} are needed at once, the set has {there}")
