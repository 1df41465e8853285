"""LightningModules: steps, losses, logging and optimizers."""

from nerfgrasp.training.grasp_value import GraspValueTraining
from nerfgrasp.training.mvnerf import MVNeRFTraining

__all__ = ["GraspValueTraining", "MVNeRFTraining"]
