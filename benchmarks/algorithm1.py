"""What the search saves on a plain Algorithm 1 of the same candidates and steps, and whether it finds as much.

    OMP_NUM_THREADS=1 python benchmarks/algorithm1.py --scenes 50 --out algorithm1.jsonl

Each scene is observed once, and three searches start from the same candidates, in turns: Algorithm 1 written plainly on
the plain network (`plain_mvnerf.py`; eager, float32, image features cached, the gradients of the poses alone), and the
schedules `paper` and `halving`. Where that takes too long, `--plain_scenes 3` leaves the plain search out after three
scenes; `paper`, which is Algorithm 1 too, then stands for its value in the others. One JSON line a scene is appended; a
run that is started again goes on where it stopped. Seconds are the wall's clock's and of the process's own time, which
counts every thread and suffers less from other processes.
"""

import json
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import plain_mvnerf
import torch
from comparison import Row, read_rows
from jsonargparse import auto_cli
from search import TUNING_SEED, observe
from torch import Tensor
from tqdm import tqdm

from nerfgrasp.allocator import keep_freed_memory
from nerfgrasp.methods.psi import ObservedScene, Psi
from nerfgrasp.models import GraspValue
from nerfgrasp.models.folder import DEFAULT_MODEL
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import PAPER, PoseParameterization, Schedule, random_candidates
from nerfgrasp.search import search as climbing_search
from nerfgrasp.search.climb import Value
from nerfgrasp.search.parameterization import load_pose
from nerfgrasp.search.strategies import find_strategy
from nerfgrasp.sim.tasks import find_task, workspace

PLAIN = "plain"
SCHEDULES = ("paper", "halving")
"""What is compared with it: these too let all candidates start, and Ψ alone judges."""


def main(
    model: str = DEFAULT_MODEL,
    scenes: int = 50,
    candidates: int = 4096,
    seed: int = TUNING_SEED,
    images: int = 3,
    chunk: int = 64,
    plain_scenes: int | None = None,
    out: Path = Path("algorithm1.jsonl"),
) -> None:
    """Compares the searches over scenes.

    Args:
        model: a folder, or a shipped model's name.
        scenes: how many simple scenes.
        candidates: random poses that climb.
        seed: of the scenes.
        images: how many are used.
        chunk: how many poses any of the searches evaluates at once.
        plain_scenes: in how many of them, from the first, the plain search takes part; in all if None.
        out: JSON lines, one a scene; scenes that it holds are not searched again.
    """
    keep_freed_memory()
    settings = {"model": model, "candidates": candidates, "seed": seed, "images": images, "chunk": chunk}
    settings |= {"threads": torch.get_num_threads(), "torch": torch.__version__}
    rows = {row["scene"]: row for row in read_rows(out, settings)}
    task, method = find_task("simple"), Psi.from_pretrained(model)
    method = Psi(method.model, images=images, chunk=chunk)
    for scene in tqdm([scene for scene in range(scenes) if scene not in rows], desc="scenes"):
        observed = method.observe(observe(task.draw(seed, scene), method.images), workspace)
        plain = plain_scenes is None or scene < plain_scenes
        rows[scene] = {"scene": scene, **settings, **compare(method, observed, scene, candidates, plain=plain)}
        with out.open("a") as file:
            file.write(json.dumps(rows[scene]) + "\n")
    print("\n".join(summary([rows[scene] for scene in sorted(rows) if scene < scenes])))


def compare(method: Psi, scene: ObservedScene, index: int, candidates: int, *, plain: bool = True) -> Row:
    """Searches one scene in all ways, each time another first; returns by each one's name what `measured` does.

    The plain search takes part if `plain`.
    """
    pose = load_pose("quaternion", scene.workspace)
    ways: list[tuple[str, Value, Callable[[Value, torch.Generator], Tensor]]] = []
    if plain:
        way = partial(plain_search, pose=pose, workspace=scene.workspace, candidates=candidates, chunk=method.chunk)
        ways.append((PLAIN, plain_value(method.model, scene), way))
    for name in SCHEDULES:
        way = partial(own_search, pose=pose, scene=scene, name=name, candidates=candidates, chunk=method.chunk)
        ways.append((name, partial(method.model.value, scene.features), way))
    first = index % len(ways)
    return {name: measured(value, way, index) for name, value, way in ways[first:] + ways[:first]}


def measured(value: Value, way: Callable[[Value, torch.Generator], Tensor], seed: int) -> Row:
    """Returns one search's seconds, how many poses it evaluated with and without gradients, and its best value."""
    counts = {"gradients": 0, "values": 0}

    def counted(T: Tensor) -> Tensor:
        counts["gradients" if T.requires_grad else "values"] += len(T)
        return value(T)

    process, start = time.process_time(), time.perf_counter()
    values = way(counted, torch.Generator().manual_seed(seed))
    seconds = {"seconds": time.perf_counter() - start, "process": time.process_time() - process}
    return {**seconds, **counts, "best": float(values.nan_to_num(nan=-torch.inf).max())}


def own_search(
    value: Value,
    generator: torch.Generator,
    *,
    pose: PoseParameterization,
    scene: ObservedScene,
    name: str,
    candidates: int,
    chunk: int,
) -> Tensor:
    """Returns the final values of a schedule's candidates."""
    schedule = find_strategy(name).climb
    arguments = {"candidates": candidates, "generator": generator, "schedule": schedule, "chunk": chunk}
    grasps, _ = climbing_search(value, pose, scene.workspace, **arguments)
    return grasps.value


def plain_search(
    value: Value,
    generator: torch.Generator,
    *,
    pose: PoseParameterization,
    workspace: Workspace,
    candidates: int,
    chunk: int,
) -> Tensor:
    """Returns the final values of as many candidates as climb by Algorithm 1, written plainly."""
    start = random_candidates(candidates, workspace, generator)
    return torch.cat([plain_climb(value, part, pose, workspace) for part in start.split(chunk)])


def plain_climb(
    value: Value, start: Tensor, pose: PoseParameterization, workspace: Workspace, schedule: Schedule = PAPER
) -> Tensor:
    """Returns the final values `[P]` of candidates `[P, 4, 4]` that climb together."""
    params = {group: param.clone() for group, param in pose.encode(start).items()}
    for phase in schedule.phases:
        moving = [params[group].requires_grad_() for group in phase.groups]
        optimizer = torch.optim.Adam(moving, lr=phase.learning_rate, maximize=True)
        rate = torch.optim.lr_scheduler.ExponentialLR(optimizer, phase.decay)
        for _ in range(phase.steps):
            optimizer.zero_grad()
            value(pose.decode(params)).sum().backward()
            torch.nn.utils.clip_grad_value_(moving, schedule.clip)
            optimizer.step()
            rate.step()
            with torch.no_grad():
                for group, projected in pose.project(params, workspace).items():
                    params[group].copy_(projected)
        for param in moving:
            param.requires_grad_(False)
    with torch.no_grad():
        return value(pose.decode(params))


def plain_value(model: GraspValue, scene: ObservedScene) -> Value:
    """Returns Ψ in one scene on the plain network, with the model's weights and its own readout."""
    maps = scene.features.fine
    with torch.no_grad():
        features = model.backbone.encoder(maps.images.flatten(0, 1)).unflatten(0, maps.images.shape[:2])

    def value(T_world_grasp: Tensor) -> Tensor:
        points, directions = model._probes(T_world_grasp.expand(len(features), *T_world_grasp.shape))
        rays = points.flatten(1, 2), directions.flatten(1, 2)
        field = model.backbone.fine
        return model.read(plain_mvnerf.activations(field, features, maps.images, maps.camera, maps.table, *rays)).mean(
            dim=0
        )

    return value


def summary(rows: Sequence[Row]) -> list[str]:
    """Returns the lines of a table where the plain search took part, of one over all scenes, and of the differences."""
    one, timed = rows[0], [row for row in rows if PLAIN in row]
    lines = [
        f"seed {one['seed']}, {one['model']}, {one['candidates']} candidates, {one['threads']} threads, "
        f"torch {one['torch']}"
    ]
    if timed:
        lines += _table(timed, (PLAIN, *SCHEDULES))
    if len(timed) < len(rows):
        lines += _table(rows, SCHEDULES)
    for name, other, where in (("paper", PLAIN, timed), ("halving", PLAIN, timed), ("halving", "paper", rows)):
        if where:
            differences = [row[name]["best"] - row[other]["best"] for row in where]
            lines.append(f"best value, {name} less {other}: {_difference(differences)}")
    return lines


def _table(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Returns a line a search; each is compared with the first."""
    lines = [
        f"{f'{len(rows)} scenes':<10} gradients   values  s, median  process s  {names[0]}/it: median, total"
        "  of process  best value, mean"
    ]
    for name in names:
        found = [row[name] for row in rows]
        seconds, process = ([entry[key] for entry in found] for key in ("seconds", "process"))
        lines.append(
            f"{name:<10}{statistics.mean(entry['gradients'] for entry in found):10.0f}"
            f"{statistics.mean(entry['values'] for entry in found):9.0f}"
            f"{statistics.median(seconds):11.2f}{statistics.median(process):11.2f}"
            f"{'':4}{_ratios(rows, names[0], name, 'seconds')}{'':2}{_ratios(rows, names[0], name, 'process')}"
            f"{statistics.mean(entry['best'] for entry in found):12.3f}"
        )
    return lines


def _ratios(rows: Sequence[Row], first: str, name: str, key: str) -> str:
    """How many times as long the first search takes: the median over scenes, and in all."""
    pairs = [(row[first][key], row[name][key]) for row in rows]
    longer, own = (sum(column) for column in zip(*pairs, strict=True))
    return f"{statistics.median(a / b for a, b in pairs):8.2f}{longer / own:8.2f}"


def _difference(differences: Sequence[float]) -> str:
    error = f"{statistics.stdev(differences) / len(differences) ** 0.5:.3f}" if len(differences) > 1 else "-"
    higher = sum(difference > 0 for difference in differences)
    return (
        f"{statistics.mean(differences):+.3f} (standard error {error}), "
        f"median {statistics.median(differences):+.3f}, from {min(differences):+.3f} to {max(differences):+.3f}, "
        f"higher in {higher} of {len(differences)}"
    )


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
