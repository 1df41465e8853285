"""`nerfgrasp replay`: shows attempts of a results file: what was seen, imagined and done."""

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image

from nerfgrasp import registry
from nerfgrasp.commands.publishing import publishing
from nerfgrasp.commands.ranges import check_ranges
from nerfgrasp.errors import UserError
from nerfgrasp.evaluation.replays import Replay, replay_scene
from nerfgrasp.evaluation.results import Row, read_results
from nerfgrasp.evaluation.trials import recorded_pose
from nerfgrasp.geometry import Camera
from nerfgrasp.grippers import DEFAULT_GRIPPER, Gripper, find_gripper
from nerfgrasp.methods.loading import find_method, load_method, method_hash, rendering_model
from nerfgrasp.models.grasp_value import GraspValue
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.scenes.scene import Grasps, Truth
from nerfgrasp.sim.attempt import Outcome
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.tasks import find_task, workspace
from nerfgrasp.viz.contact_sheet import contact_sheet, stack
from nerfgrasp.viz.figures import Panel, picture, to_image
from nerfgrasp.viz.film_strip import close_up, film_strip
from nerfgrasp.viz.imagination import grasp_camera, imagine_from_grasp, imagined_panels

_COLUMNS = 8
"""Frames in a row."""


def replay(
    results: Path,
    *,
    scene: int | None = None,
    count: int = 5,
    model: str | None = None,
    gripper: str | None = None,
    objects: Path | None = None,
    size: int = IMAGE_SIZE,
    out: Path | None = None,
) -> None:
    """Shows attempts of a results file: the failures, or all of a scene.

    Each is carried out again, from what the attempts before it left, and must end as it did. Writes a picture an
    attempt, `scene-000017-attempt-0.png` and so on: the grasp in the images that the method was given, the scene from
    the grasp's own viewpoint and what the model imagines there, and the stages in physics. All or none.

    Args:
        results: what `nerfgrasp evaluate --out` wrote.
        scene: the number of the scene whose attempts are shown, successes too; the first failures if not given.
        count: how many failures are shown at most.
        model: the model's folder or shipped name, for what it imagines; nothing is imagined if not given.
        gripper: the hand that carried the grasps out, where it is not a registered one: its YAML file.
        objects: the folder of the novel objects, as for `evaluate`.
        size: width and height of the pictures in pixels, as `evaluate` was given.
        out: folder of the pictures; RESULTS-replay if not given.

    Raises:
        UserError: something asked for is not there or damaged, the model is another, the results are of other physics,
            objects or pictures, or the pictures cannot be written.
    """
    check_ranges(scene=scene, count=count, size=size)
    rows = read_results(results)
    chosen = _choose(rows, results, scene, count)
    hand = _find_hand(rows[0], gripper)
    task = find_task(rows[0].task, objects)
    value = None if model is None else _load_value(model, rows[0])
    name = results.name.removesuffix(".gz").removesuffix(".jsonl")
    destination = Path(f"{name}-replay") if out is None else out
    with publishing(destination) as folder:
        for number in dict.fromkeys(row.scene for row in chosen):
            mine = [row for row in rows if row.scene == number]
            last = max(row.attempt for row in chosen if row.scene == number)
            for shown in replay_scene(task, mine[: last + 1], size, hand):
                if shown.row in chosen:
                    print(heading(shown.row), flush=True)
                    file = f"scene-{number:06d}-attempt-{shown.row.attempt}.png"
                    attempt_picture(shown, value, hand).save(folder / file)
    print(f"wrote {len(chosen)} pictures to {destination}")


def heading(row: Row) -> str:
    """Returns the line that tells of an attempt."""
    parts = [f"scene {row.scene}, attempt {row.attempt}: {row.outcome}"]
    if row.value is not None:
        parts.append(f"value {row.value:.2f}")
    if row.errors is not None:
        parts.append("{distance_mm:.1f} mm and {angle_deg:.1f}° from the nearest valid grasp".format(**row.errors))
    return "; ".join(parts)


def attempt_picture(shown: Replay, model: GraspValue | None, gripper: Gripper = DEFAULT_GRIPPER) -> Image.Image:
    """Draws one attempt: the images with the grasp, the scene and what the model imagines from it, and its stages."""
    row, seen = shown.row, shown.observations
    if row.grasp is None:
        return stack([[to_image(image) for image in seen.images.permute(0, 2, 3, 1)]], {0: heading(row)})
    T = recorded_pose(row.grasp).float()
    from_grasp = [_true_panel(shown.truth, grasp_camera(T))]
    if model is not None:
        [imagined] = imagined_panels(imagine_from_grasp(model, seen, workspace, T))
        from_grasp += imagined
    over = picture(seen, Grasps(T[None], torch.zeros(1)), gripper, [from_grasp])
    stages = contact_sheet([film_strip("", shown.frames, close_up(T))], _COLUMNS)
    return stack([[over], [stages]], {0: heading(row)})


def _true_panel(truth: Truth, camera: Camera) -> Panel:
    images, _ = render_scene(truth, camera[None])
    return Panel("the scene from the grasp", torch.from_numpy(images[0]) / 255, camera, fingers_only=True)


def _choose(rows: Sequence[Row], results: Path, scene: int | None, count: int) -> list[Row]:
    if scene is not None:
        chosen = [row for row in rows if row.scene == scene]
        if not chosen:
            raise UserError(f"{results} holds no scene {scene}: its scenes are 0 to {max(row.scene for row in rows)}")
        return chosen
    chosen = [row for row in rows if row.outcome != Outcome.SUCCESS][:count]
    if not chosen:
        raise UserError(f"{results}: every attempt succeeded; --scene shows one")
    return chosen


def _find_hand(row: Row, gripper: str | None) -> Gripper:
    """Returns the hand of the results: a registered one by its name in the row, or the YAML file that was given."""
    if gripper is None and row.gripper is not None and row.gripper not in registry.names(registry.GRIPPERS):
        raise UserError(f"the results are of the gripper {row.gripper!r}, which is not registered: give its YAML file")
    return find_gripper(gripper or row.gripper or DEFAULT_GRIPPER)


def _load_value(name: str, row: Row) -> GraspValue:
    """Returns the grasp value that made the results, which can render.

    Raises:
        UserError: it is another model, or renders nothing.
    """
    method = load_method(find_method(name))
    found = rendering_model(method)
    if found is None:
        raise UserError(f"model {name} renders nothing: leave --model out")
    if method_hash(method) != row.model:
        raise UserError(f"model {name} is {method_hash(method)}, the results are of {row.model or 'no model'}")
    return found
