"""The picture of what models imagine in the simulated tasks: the paper's figure 3.

    python benchmarks/renderings.py --models '[mv3-laptop, RUN/model]' --objects YCB_FOLDER

writes docs/renderings.png: of one scene of each task the three input images, each model's rendering of a view that it
has not seen, RGB and depth, and the truth. No model has seen depth. Captions give PSNR over the objects' pixels. The
scenes' seed is held out of every training set; without `--objects` the novel objects are those that come with PyBullet.
"""

from dataclasses import replace
from pathlib import Path

import torch
from jsonargparse import auto_cli
from tqdm import tqdm

from nerfgrasp.files import replacing
from nerfgrasp.models.folder import DEFAULT_MODEL, load_backbone
from nerfgrasp.models.scores import image_scores
from nerfgrasp.scenes.images import IMAGE_SIZE
from nerfgrasp.scenes.scene import Observations
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.tasks import TASKS, find_task, scene_cameras, workspace
from nerfgrasp.viz.contact_sheet import Section, contact_sheet
from nerfgrasp.viz.figures import at_width
from nerfgrasp.viz.renderings import panels, render_views

INPUTS = 3
"""Images of a scene that are shown as input; a model takes as many as it sees at once, from the front."""
SIDE = 160
"""Pixels of an image in the picture."""
HEADINGS = {"simple": "simple", "clutter": "clutter", "novel": "novel: {name}"}


def main(
    models: tuple[str, ...] = (DEFAULT_MODEL,),
    objects: Path | None = None,
    seed: int = 7,
    scene: int = 0,
    view: int = INPUTS,
    size: int = IMAGE_SIZE,
    out: Path = Path("docs/renderings.png"),
) -> None:
    """Draws the picture.

    Args:
        models: model folders or names of shipped ones; named in the picture by their folders.
        objects: a folder of object models for the novel task.
        seed: of the scenes.
        scene: the number of the scene of each task.
        view: the number of the view that is rendered; those below 3 are inputs.
        size: side in pixels of what models see and render.
        out: the picture.
    """
    sections = [task_section(task, models, objects, seed, scene, view, size) for task in tqdm(TASKS, desc="tasks")]
    picture = contact_sheet(sections, columns=INPUTS + 2 * len(models) + 2)
    with replacing(out) as temporary:
        picture.save(temporary, format="PNG", optimize=True)
    print(out)


def task_section(
    name: str, models: tuple[str, ...], objects: Path | None, seed: int, scene: int, view: int, size: int
) -> Section:
    """Returns one task's row: the inputs, then of each model and of the truth RGB and depth of one view."""
    truth = find_task(name, objects if name == "novel" else None).draw(seed, scene)
    camera = scene_cameras(seed, scene, view + 1, size)
    pictures, masks, depth = render_scene(truth, camera, depth=True)
    images = torch.from_numpy(pictures).float().div(255).movedim(-1, 1)
    shown = {f"input {number + 1}": images[number].movedim(0, -1) for number in range(INPUTS)}
    known = {"truth": images[view].movedim(0, -1), "true_depth": torch.from_numpy(depth[view])}
    for model in models:
        network = load_backbone(model)
        seen = Observations(images, camera).select(slice(network.config.views))
        rendered = replace(next(render_views(network, seen, camera[view : view + 1], workspace)), **known)
        scores = image_scores(
            rendered.rgb.movedim(-1, 0), images[view], rendered.inside, torch.from_numpy(masks[view] > 0)
        )
        drawn = panels(rendered)
        shown[f"{_title(model)}: {float(scores['psnr_objects']):.1f} dB"] = drawn["rendered"].image
        shown[f"{_title(model)}: depth"] = drawn["depth"].image
    shown |= {"truth": drawn["truth"].image, "truth: depth": drawn["true depth"].image}
    heading = HEADINGS[name].format(name=" and ".join(getattr(thing, "name", "") for thing in truth.objects))
    return Section(heading, tuple(at_width(image, SIDE) for image in shown.values()), tuple(shown))


def _title(model: str) -> str:
    """Returns a model's name: that of its folder, or of the run whose `model` it is."""
    path = Path(model)
    return path.parent.name if path.name == "model" else path.name


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
