"""How long a search takes: by model, schedule, number of candidates and number of images.

    python benchmarks/search.py --models '[mv3-laptop, mv1-laptop]' --schedules '[guided, resample]'
    python benchmarks/search.py --candidates '[64, 256, 1024, 4096]' --images '[3, 6]'

Simple scenes of the tuning seed are rendered, observed and searched, case by case in turns, because machines are noisy.
Medians over scenes: seconds by the wall's clock, and of the process's own time, which counts every thread. The peak of
memory is that of a process which does nothing else, first with the model loaded, then after one search.
"""

import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import torch
from backbone import pictures
from jsonargparse import auto_cli
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.methods.psi import Psi
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.scene import Observations, Truth
from nerfgrasp.search.strategies import DEFAULT_STRATEGY, find_strategy
from nerfgrasp.sim.tasks import find_task, scene_cameras, workspace

TUNING_SEED = 101


class Case(NamedTuple):
    """One way to search."""

    model: str
    schedule: str
    candidates: int | None
    images: int


class Spent(NamedTuple):
    """Seconds of one search."""

    observe: float
    search: float
    process: float
    """Of both, over all threads."""


def main(
    models: tuple[str, ...] = (DEFAULT_MODEL,),
    schedules: tuple[str, ...] = (DEFAULT_STRATEGY,),
    candidates: tuple[int, ...] = (),
    images: tuple[int, ...] = (3,),
    scenes: int = 5,
) -> None:
    """Prints a line for each combination.

    Args:
        models: model folders or names of shipped ones.
        schedules: names; see docs/search.md.
        candidates: in place of the schedules' own numbers.
        images: how many images are used.
        scenes: how many scenes are searched, after one that does not count.
    """
    keep_freed_memory()
    found = {model: Psi.from_pretrained(model) for model in models}
    cases = [Case(*values) for values in product(models, schedules, candidates or (None,), images)]
    spent: dict[Case, list[Spent]] = {case: [] for case in cases}
    for scene in tqdm(range(scenes + 1), desc="scenes"):
        observations = observe(find_task("simple").draw(TUNING_SEED, scene), max(images))
        for case in cases:
            method = Psi(found[case.model].model, images=case.images)
            seconds = search(method, case, observations.select(slice(case.images)), scene)
            spent[case] += [seconds] if scene else []
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}, medians over {scenes} scenes")
    print(
        "model               schedule    candidates  images  observe, s  search, s  together, s  process, s  memory, MB"
    )
    for case, rows in spent.items():
        observe_s, search_s, process_s = (statistics.median(column) for column in zip(*rows, strict=True))
        loaded, peak = isolated_memory(case)
        count = find_strategy(case.schedule, candidates=case.candidates).candidates
        print(
            f"{case.model:<20}{case.schedule:<12}{count:10d}{case.images:8d}{observe_s:12.2f}{search_s:11.2f}"
            f"{statistics.median(row.observe + row.search for row in rows):9.2f}{process_s:12.2f}"
            f"{loaded:6.0f}{peak:6.0f}"
        )


def observe(truth: Truth, views: int) -> Observations:
    """Returns what so many cameras see of a scene."""
    camera = scene_cameras(truth.seed, truth.index, views)
    images, _ = pictures(truth, camera)
    return Observations(images, camera)


def search(method: Psi, case: Case, observations: Observations, seed: int) -> Spent:
    """Returns how long one search takes."""
    strategy = find_strategy(case.schedule, candidates=case.candidates)
    process, start = time.process_time(), time.perf_counter()
    observed = method.observe(observations, workspace)
    middle = time.perf_counter()
    method.search(observed, generator=torch.Generator().manual_seed(seed), strategy=strategy)
    end = time.perf_counter()
    return Spent(middle - start, end - middle, time.process_time() - process)


def isolated_memory(case: Case) -> tuple[float, float]:
    """Returns what `memory` does, of a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(memory, case).result()


def memory(case: Case) -> tuple[float, float]:
    """Returns this process's peak memory in MB with the model loaded, and after a search in the first scene."""
    keep_freed_memory()
    method = Psi(Psi.from_pretrained(case.model).model, images=case.images)
    observations = observe(find_task("simple").draw(TUNING_SEED, 0), case.images)
    before = _peak()
    search(method, case, observations, 0)
    return before, _peak()


def _peak() -> float:
    """Linux's own account of this program: `ru_maxrss` would begin at the parent's peak."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
