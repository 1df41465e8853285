"""Cameras, rays and frames.

One convention everywhere: OpenCV cameras (x right, y down, z forward), metres, radians, `T_a_b` maps
coordinates in frame b to frame a as a 4x4 matrix, quaternions are xyzw, batch dimensions lead, and pixel
centres lie at +0.5.
"""

from nerfgrasp.geometry.cameras import (
    Camera,
    depth_along_axis,
    look_at,
    pixel_centres,
    pixel_rays,
    project,
    sees_box,
    shrink,
)
from nerfgrasp.geometry.crops import crop_to_box
from nerfgrasp.geometry.frames import invert, is_rigid, make_pose, transform
from nerfgrasp.geometry.precision import exact
from nerfgrasp.geometry.rays import box_intersection

__all__ = [
    "Camera",
    "box_intersection",
    "crop_to_box",
    "depth_along_axis",
    "exact",
    "invert",
    "is_rigid",
    "look_at",
    "make_pose",
    "pixel_centres",
    "pixel_rays",
    "project",
    "sees_box",
    "shrink",
    "transform",
]
