"""The truth and the workspace as JSON data: one form for scene folders and for packed sets."""

from typing import Any

import torch
from torch import Tensor

from nerfgrasp.errors import UserError
from nerfgrasp.scenes.arrays import workspace_from_corners
from nerfgrasp.scenes.objects import object_from_json
from nerfgrasp.scenes.scene import Truth, Workspace


def tensor_to_json(tensor: Tensor) -> Any:
    """Returns a float tensor as nested lists of the shortest decimals that read back to the same float32.

    Example:
        >>> tensor_to_json(torch.tensor([0.1, -2.0]))
        [0.1, -2.0]
    """
    if tensor.ndim:
        return [tensor_to_json(part) for part in tensor]
    return float(str(tensor.detach().cpu().float().numpy()[()]))


def workspace_to_json(workspace: Workspace) -> dict[str, Any]:
    """Returns plain JSON data that `workspace_from_json` reads back exactly."""
    return {"minimum": tensor_to_json(workspace.minimum), "maximum": tensor_to_json(workspace.maximum)}


def workspace_from_json(data: Any, where: str) -> Workspace:
    """Reads what `workspace_to_json` wrote, or what a user wrote by hand.

    Raises:
        UserError: it is not two corners of a box; the message begins with `where`.
    """
    if not isinstance(data, dict) or not {"minimum", "maximum"} <= data.keys():
        raise UserError(f"{where}: workspace needs 'minimum' and 'maximum', three numbers in metres each")
    return workspace_from_corners(data["minimum"], data["maximum"], f"{where}: workspace")


def truth_to_json(truth: Truth) -> dict[str, Any]:
    """Returns plain JSON data that `truth_from_json` reads back exactly."""
    demonstration = None if truth.demonstration is None else tensor_to_json(truth.demonstration)
    return {
        "task": truth.task,
        "seed": truth.seed,
        "index": truth.index,
        "objects": [thing.to_json() for thing in truth.objects],
        "demonstration": demonstration,
    }


def truth_from_json(data: Any, where: str) -> Truth:
    """Reads what `truth_to_json` wrote.

    Raises:
        UserError: something is missing or of another kind; the message begins with `where`.
    """
    try:
        demonstration = data["demonstration"]
        return Truth(
            task=data["task"],
            seed=data["seed"],
            index=data["index"],
            objects=tuple(object_from_json(thing) for thing in data["objects"]),
            demonstration=None if demonstration is None else torch.tensor(demonstration, dtype=torch.float32),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{where}: damaged truth ({type(error).__name__}: {error})") from error
