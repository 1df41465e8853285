"""Plain `nn.Module`s and functions: encoder, field, volume rendering, MVNeRF and the grasp value Ψ."""

from nerfgrasp.models.encoder import Encoder, EncoderConfig
from nerfgrasp.models.field import Field, FieldConfig
from nerfgrasp.models.grasp_value import GraspValue, GraspValueConfig
from nerfgrasp.models.mvnerf import MVNeRF, MVNeRFConfig, SceneFeatures
from nerfgrasp.models.rendering import Rendering, render_image

__all__ = [
    "Encoder",
    "EncoderConfig",
    "Field",
    "FieldConfig",
    "GraspValue",
    "GraspValueConfig",
    "MVNeRF",
    "MVNeRFConfig",
    "Rendering",
    "SceneFeatures",
    "render_image",
]
