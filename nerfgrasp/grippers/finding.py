"""Grippers by name, and a user's gripper from a YAML file."""

import hashlib
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import torch
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import is_rigid
from nerfgrasp.grippers.built_in import DEFAULT_GRIPPER
from nerfgrasp.grippers.gripper import Fingers, Gripper, HandModel, Probes

Length = Annotated[float, Field(gt=0, le=1)]
"""Metres."""
LengthOrZero = Annotated[float, Field(ge=0, le=1)]
Mass = Annotated[float, Field(gt=0, le=100)]
"""Kilograms."""
_PALM_MARGIN, _WIDTH_MARGIN = 0.005, 0.015
"""Space in metres that is kept before the palm and between the open fingers where a file does not say otherwise."""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _ProbesInFile(_File):
    closing: Length = Field(description="distance of the inward rays from the TCP along the closing axis, metres")
    across: Length = Field(description="distance of all rays from the closing plane, metres")
    approach: Length = Field(description="distance of the inward rays from the TCP along the approach, metres")
    reach: Length = Field(description="distance from a ray's start to its outermost points, metres")


class _GripperInFile(_File):
    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$", description="name of the gripper in results")
    stroke: Length = Field(description="distance between the pads when open, metres")
    finger_length: Length = Field(description="distance from the palm to the fingertips, metres")
    finger_thickness: Length = Field(description="thickness of a finger along the closing axis, metres")
    pad_width: Length = Field(description="width of a pad across the closing axis, metres")
    pad_height: Length = Field(description="height of a pad along the approach, metres")
    body: list[Length] = Field(min_length=3, max_length=3, description="extents of the body along x, y, z, metres")
    title: str | None = None
    max_width: Length | None = None
    clearance: LengthOrZero = Fingers.clearance
    palm_reach: Length | None = None
    setback: LengthOrZero = Gripper.setback
    body_mass: Mass = Gripper.body_mass
    finger_mass: Mass = Gripper.finger_mass
    probes: _ProbesInFile | None = None
    urdf: str | None = None
    finger_joints: Annotated[list[str], Field(min_length=2, max_length=2)] | None = None
    tcp_offset: Annotated[float, Field(ge=-1, le=1)] | None = None
    T_base_tcp: list[Annotated[list[float], Field(min_length=4, max_length=4)]] | None = None


def find_gripper(name: str | Path | Gripper = DEFAULT_GRIPPER) -> Gripper:
    """Returns a gripper by its registered name or from a YAML file. A gripper is returned as it is.

    Example:
        >>> find_gripper("franka").fingers.stroke
        0.08

    Raises:
        UserError: there is no gripper with this name, a plug-in registers something else under it, or the file is
            wrong; see `read_gripper`.
    """
    if isinstance(name, Gripper):
        return name
    if Path(name).suffix in (".yaml", ".yml"):
        return read_gripper(Path(name))
    found = registry.load(registry.GRIPPERS, str(name))
    if not isinstance(found, Gripper):
        entry = registry.find(registry.GRIPPERS, str(name))
        raise UserError(
            f"gripper {name!r} ({entry}) is of type {type(found).__name__}, not Gripper (the plug-in is at fault)"
        )
    return found


def read_gripper(path: Path) -> Gripper:
    """Reads a gripper from a YAML file; docs/grippers.md lists the keys.

    Raises:
        UserError: the file cannot be read, a key is missing, unknown or has a wrong value, or dimensions contradict
            each other. The message names the file and the key.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        found = _GripperInFile.model_validate(data)
        return _gripper(found, path)
    except ValidationError as error:
        raise UserError(f"{path}: {_first_line(error)}") from None
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _gripper(found: _GripperInFile, path: Path) -> Gripper:
    """Returns the gripper of a file that has been read."""
    if found.name in registry.names(registry.GRIPPERS):
        raise UserError(f"name is {found.name!r}: that is a registered gripper")
    width = found.stroke - min(_WIDTH_MARGIN, found.stroke / 4) if found.max_width is None else found.max_width
    depth = found.finger_length - found.pad_height / 2
    reach = depth - min(_PALM_MARGIN, depth / 4) if found.palm_reach is None else found.palm_reach
    fingers = Fingers(
        found.stroke, width, found.finger_thickness, found.pad_width, found.pad_height, found.clearance, reach
    )
    x, y, z = found.body
    return Gripper(
        found.name,
        found.title or found.name,
        fingers,
        found.finger_length,
        found.setback,
        (x, y, z),
        found.body_mass,
        found.finger_mass,
        own_probes=None if found.probes is None else Probes(**found.probes.model_dump()),
        hand_model=_hand_model(found, path.parent),
    )


def _hand_model(found: _GripperInFile, folder: Path) -> HandModel | None:
    """Returns the URDF that a file names, after a check of its joints; None if it names none."""
    placed = [key for key in ("finger_joints", "tcp_offset", "T_base_tcp") if getattr(found, key) is not None]
    if found.urdf is None:
        if placed:
            raise UserError(f"{placed[0]} is given without urdf")
        return None
    if found.finger_joints is None:
        raise UserError("finger_joints is missing: the names of the two prismatic joints in the urdf")
    if (found.tcp_offset is None) == (found.T_base_tcp is None):
        raise UserError("urdf needs either tcp_offset, along z of its base link in metres, or T_base_tcp, a 4x4 matrix")
    T = found.T_base_tcp
    if T is None:
        T = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, found.tcp_offset or 0.0], [0.0, 0.0, 0.0, 1.0]]
    if not _is_rigid(T):
        raise UserError("T_base_tcp is not a rigid 4x4 transform")
    path = (folder / found.urdf).resolve()
    first, second = found.finger_joints
    rows = tuple((a, b, c, d) for a, b, c, d in T)
    return HandModel(path, (first, second), rows, _checked_urdf(path, found.finger_joints))


def _is_rigid(T: list[list[float]]) -> bool:
    return len(T) == 4 and bool(is_rigid(torch.tensor(T, dtype=torch.float64)))


def _checked_urdf(path: Path, finger_joints: list[str]) -> str:
    """Returns the SHA-256 of a URDF and its meshes, after a check that its finger joints are prismatic."""
    try:
        data = path.read_bytes()
        root = ElementTree.fromstring(data)
    except OSError as error:
        raise UserError(f"urdf: cannot read {path}: {error.strerror or error}") from error
    except ElementTree.ParseError as error:
        raise UserError(f"urdf: {path} is not valid XML: {error}") from error
    kinds = {joint.get("name"): joint.get("type") for joint in root.iter("joint")}
    for name in finger_joints:
        if kinds.get(name) != "prismatic":
            there = ", ".join(str(one) for one, kind in kinds.items() if kind == "prismatic") or "none"
            raise UserError(f"finger_joints: {name!r} is not a prismatic joint of {path} (choices: {there})")
    digest = hashlib.sha256(data)
    for mesh in sorted({mesh.get("filename", "") for mesh in root.iter("mesh")}):
        try:
            digest.update((path.parent / mesh).read_bytes())
        except OSError as error:
            raise UserError(f"urdf: {path} names the mesh {mesh!r}, which cannot be read") from error
    return digest.hexdigest()


def _first_line(error: ValidationError) -> str:
    """Returns the first problem of a file as one line that names the key."""
    problem = error.errors()[0]
    place = [str(part) for part in problem["loc"]]
    key = ".".join(place)
    if problem["type"] == "missing":
        description = (_ProbesInFile if len(place) > 1 else _GripperInFile).model_fields[place[-1]].description
        return f"{key} is missing: {description}"
    if problem["type"] == "extra_forbidden":
        known = (_ProbesInFile if len(place) > 1 else _GripperInFile).model_fields
        near = get_close_matches(place[-1], known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"the keys are {', '.join(known)}"
        return f"{key} is unknown: {hint}"
    if not place:
        return "it does not hold a gripper's keys and values"
    return f"{key} is {problem['input']!r}: {problem['msg'][0].lower()}{problem['msg'][1:]}"
